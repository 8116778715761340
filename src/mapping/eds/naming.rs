//! Names of tags from what makers call their objects.

use std::collections::BTreeSet;

use super::model::{Eds, ObjectId};

/// Longest name of a tag.
const LONGEST: usize = 64;
/// Words that mean something else in a condition.
const RESERVED: [&str; 5] = ["and", "or", "not", "true", "false"];

/// A text in snake case: `Actual Position (µm)` and `ActualPosition µm` become `actual_position_um`.
#[must_use]
pub fn snake(text: &str) -> String {
    let mut name = String::new();
    let letters: Vec<char> = text.chars().collect();
    for (index, letter) in letters.iter().enumerate() {
        let before = index.checked_sub(1).and_then(|before| letters.get(before));
        let after = letters.get(index + 1);
        let starts_word = letter.is_uppercase()
            && before.is_some_and(|before| {
                before.is_lowercase()
                    || before.is_uppercase() && after.is_some_and(|after| after.is_lowercase())
            });
        if starts_word {
            separate(&mut name);
        }
        match plain(*letter) {
            "" if letter.is_ascii_alphanumeric() => name.push(letter.to_ascii_lowercase()),
            "" => separate(&mut name),
            plain => name.push_str(plain),
        }
    }
    name.trim_end_matches('_').to_owned()
}

fn separate(name: &mut String) {
    if !name.is_empty() && !name.ends_with('_') {
        name.push('_');
    }
}

/// Letters beyond ASCII that makers use, in ASCII.
fn plain(letter: char) -> &'static str {
    match letter {
        'ä' | 'Ä' | 'æ' | 'Æ' => "ae",
        'ö' | 'Ö' | 'ø' | 'Ø' => "oe",
        'ü' | 'Ü' => "ue",
        'ß' => "ss",
        'à' | 'á' | 'â' | 'ã' | 'å' | 'À' | 'Á' | 'Â' | 'Ã' | 'Å' => "a",
        'ç' | 'Ç' => "c",
        'è' | 'é' | 'ê' | 'ë' | 'È' | 'É' | 'Ê' | 'Ë' => "e",
        'ì' | 'í' | 'î' | 'ï' | 'Ì' | 'Í' | 'Î' | 'Ï' => "i",
        'ñ' | 'Ñ' => "n",
        'ò' | 'ó' | 'ô' | 'õ' | 'Ò' | 'Ó' | 'Ô' | 'Õ' => "o",
        'ù' | 'ú' | 'û' | 'Ù' | 'Ú' | 'Û' | 'µ' | 'μ' => "u",
        '°' => "deg",
        'Ω' | '\u{2126}' => "ohm",
        _ => "",
    }
}

/// What the maker calls an object: the names of the array or record and of the sub-index, where they differ.
#[must_use]
pub fn title(eds: &Eds, object: ObjectId) -> String {
    let own = eds.objects.get(&object).map(|object| object.name.as_str()).unwrap_or_default();
    let group = eds.groups.get(&object.index).map(String::as_str).unwrap_or_default();
    let begins = |text: &str, with: &str| snake(text).starts_with(&snake(with));
    match (group, own) {
        ("", own) => own.to_owned(),
        (group, "") => format!("{group} {}", object.sub),
        (group, own) if begins(own, group) => own.to_owned(),
        (group, own) => format!("{group}: {own}"),
    }
}

/// Names that are taken.
#[derive(Clone, Debug, Default)]
pub struct Names(pub BTreeSet<String>);

impl Names {
    /// A name for an object that no other has, made of its title.
    pub fn name(&mut self, eds: &Eds, object: ObjectId) -> String {
        let mut name = snake(&title(eds, object));
        let suffix = format!("_{:04x}_{}", object.index, object.sub);
        if name.is_empty() {
            name = format!("object{suffix}");
        } else if !name.starts_with(|first: char| first.is_ascii_lowercase())
            || RESERVED.contains(&name.as_str())
        {
            name = format!("value_{name}");
        }
        shorten(&mut name, LONGEST);
        if self.0.contains(&name) {
            shorten(&mut name, LONGEST - suffix.len());
            name.push_str(&suffix);
        }
        // Only a name that was written by hand can still be the same.
        let mut number = 2;
        while self.0.contains(&name) {
            let suffix = format!("_{number}");
            shorten(&mut name, LONGEST - suffix.len());
            name.push_str(&suffix);
            number += 1;
        }
        self.0.insert(name.clone());
        name
    }
}

/// Cuts a name of ASCII letters to a length, without an underline at its end.
fn shorten(name: &mut String, most: usize) {
    name.truncate(most);
    name.truncate(name.trim_end_matches('_').len());
}

#[cfg(test)]
mod tests {
    use super::super::read::read;
    use super::*;

    #[test]
    fn titles_become_snake_case_whatever_their_letters() {
        for (title, expected) in [
            ("Actual Position (µm)", "actual_position_um"),
            ("ActualPosition", "actual_position"),
            ("PDOMapping", "pdo_mapping"),
            ("statusword", "statusword"),
            ("Statuswort 2: Überlauf", "statuswort_2_ueberlauf"),
            ("Températur [°C]", "temperatur_degc"),
            ("AI_1__value-", "ai_1_value"),
            ("温度", ""),
            ("", ""),
        ] {
            assert_eq!(snake(title), expected, "{title}");
        }
    }

    #[test]
    fn names_are_valid_and_unique_for_any_title() {
        let text = "[6401]\nParameterName=Input\nObjectType=8\n[6401sub1]\nParameterName=Input 1\n[6401sub2]\nParameterName=Level\n\
            [2000]\nParameterName=Input 1\n[2001]\nParameterName=not\n[2002]\nParameterName=24V\n[2003]\nParameterName=温\n";
        let (eds, _) = read("a.eds", text.as_bytes()).unwrap();
        let mut names = Names::default();
        let found: Vec<String> = eds.objects.keys().map(|object| names.name(&eds, *object)).collect();
        assert_eq!(
            found,
            ["input_1", "value_not", "value_24v", "object_2003_0", "input_1_6401_1", "input_level"]
        );
    }

    #[test]
    fn long_names_are_cut_and_stay_unique() {
        let text = format!("[2000]\nParameterName={0}\n[2001]\nParameterName={0}\n", "long ".repeat(40));
        let (eds, _) = read("a.eds", text.as_bytes()).unwrap();
        let mut names = Names::default();
        for object in eds.objects.keys() {
            let name = names.name(&eds, *object);
            assert!(crate::mapping::build::is_snake_case(&name), "{name}");
        }
        assert_eq!(names.0.len(), 2);
    }
}
