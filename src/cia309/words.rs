//! The words of a line: separated by blanks; one in double quotes may hold blanks, `#`, and `""` for a quote. A `#`
//! outside quotes begins a comment.

/// A word.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Word {
    /// As it was written.
    Plain(String),
    /// What stood between the quotes.
    Quoted(String),
}

impl Word {
    /// What it says, quotes or not.
    #[must_use]
    pub fn text(&self) -> &str {
        match self {
            Self::Plain(text) | Self::Quoted(text) => text,
        }
    }

    /// What it says in lower case, if it is not quoted: commands, options and types have no case.
    #[must_use]
    pub fn lower(&self) -> String {
        match self {
            Self::Plain(text) => text.to_ascii_lowercase(),
            Self::Quoted(_) => String::new(),
        }
    }
}

/// The words of a text; `None` where a quote is not closed, or stands within a word.
#[must_use]
pub fn words(text: &str) -> Option<Vec<Word>> {
    let mut words = Vec::new();
    let mut rest = text.trim_start_matches(is_blank);
    while !rest.is_empty() && !rest.starts_with('#') {
        let (word, after) = match rest.strip_prefix('"') {
            Some(quoted) => quoted_word(quoted)?,
            None => plain_word(rest)?,
        };
        // Nothing but a blank or a comment may follow a quote.
        if !after.is_empty() && !after.starts_with(is_blank) && !after.starts_with('#') {
            return None;
        }
        words.push(word);
        rest = after.trim_start_matches(is_blank);
    }
    Some(words)
}

fn is_blank(letter: char) -> bool {
    matches!(letter, ' ' | '\t')
}

fn plain_word(text: &str) -> Option<(Word, &str)> {
    let end = text.find(|letter| is_blank(letter) || letter == '#').unwrap_or(text.len());
    let (word, after) = text.split_at(end);
    (!word.contains('"')).then(|| (Word::Plain(word.to_owned()), after))
}

/// From behind the opening quote to behind the closing one.
fn quoted_word(text: &str) -> Option<(Word, &str)> {
    let mut word = String::new();
    let mut rest = text;
    loop {
        let (part, after) = rest.split_once('"')?;
        word.push_str(part);
        match after.strip_prefix('"') {
            Some(more) => {
                word.push('"');
                rest = more;
            }
            None => return Some((Word::Quoted(word), after)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain(text: &str) -> Word {
        Word::Plain(text.to_owned())
    }

    #[test]
    fn words_are_separated_by_blanks_and_end_at_a_comment() {
        assert_eq!(words(" r\t0x1018  1 u32 # why"), Some(["r", "0x1018", "1", "u32"].map(plain).into()));
        assert_eq!(words("start#now"), Some(vec![plain("start")]));
        assert_eq!(words("# nothing"), Some(vec![]));
        assert_eq!(words(""), Some(vec![]));
    }

    #[test]
    fn quotes_hold_blanks_comments_and_doubled_quotes() {
        let quoted = |text: &str| Some(vec![plain("vs"), Word::Quoted(text.to_owned())]);
        assert_eq!(words("vs \"a b # c\""), quoted("a b # c"));
        assert_eq!(words("vs \"say \"\"hello\"\"\"#comment"), quoted("say \"hello\""));
        assert_eq!(words("vs \"\""), quoted(""));
        for wrong in ["vs \"open", "vs \"a\"b", "vs a\"b", "vs \"a\"\"", "\""] {
            assert_eq!(words(wrong), None, "{wrong}");
        }
    }
}
