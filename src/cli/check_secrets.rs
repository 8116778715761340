//! What `check` says of the files with tokens and hashes of passwords that `[access.NAME]` tables name \[IO\].

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;

use crate::access::PasswordHash;
use crate::config::Settings;
use crate::mapping::{At, Diagnostic, SourceText};

/// Bits of a file's mode that let everybody read or write it.
const OTHERS: u32 = 0o006;
/// As in the login by token: what is shorter can be guessed.
const SHORTEST_TOKEN: usize = crate::web::login::SHORTEST_TOKEN;

/// Warnings, as the files are those of the computer where the gateway runs, and this may be another one.
pub(super) fn check(source: &SourceText, settings: &Settings) -> Vec<Diagnostic> {
    let token = |text: &str| {
        (text.trim().len() < SHORTEST_TOKEN).then(|| format!("a token has {SHORTEST_TOKEN} bytes or more"))
    };
    let password = |text: &str| PasswordHash::parse(text).err().map(|error| error.to_string());
    let mut warnings = Vec::new();
    for entry in settings.access.values() {
        warnings.extend(entry.token_file.iter().filter_map(|at| look(source, at, token)));
        warnings.extend(entry.password_file.iter().filter_map(|at| look(source, at, password)));
    }
    warnings
}

/// What is wrong with a file, without anything that stands in it.
fn look(source: &SourceText, at: &At<String>, wrong: impl Fn(&str) -> Option<String>) -> Option<Diagnostic> {
    let file = &at.value;
    let read = fs::read_to_string(file).and_then(|text| Ok((text, fs::metadata(file)?.mode())));
    let (message, hint) = match read {
        Err(error) if error.kind() == io::ErrorKind::InvalidData => {
            (format!("`{file}`: it is no text"), "nobody can log in by it")
        }
        Err(error) => (format!("cannot read `{file}`: {error}"), "nobody can log in by it where that is so"),
        Ok((text, mode)) => match wrong(&text) {
            Some(message) => (format!("`{file}`: {message}"), "nobody can log in by it"),
            None if mode & OTHERS != 0 => {
                (format!("everybody on this host can read or write `{file}`"), "`chmod 640` it")
            }
            None => return None,
        },
    };
    Some(source.warning(&at.span, message, hint))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn s13_files_that_let_nobody_in_or_everybody_look_are_warned_of_without_what_stands_in_them() {
        let folder = tempfile::tempdir().unwrap();
        let hash =
            "$argon2id$v=19$m=19456,t=2,p=1$c2FsdHNhbHRzYWx0$i1ZbHXvRKg4oGAMRmRf2WRWM3kLHSDBTbq4/jXrsxgI";
        let said = |key: &str, content: &[u8], mode: u32| {
            let path = folder.path().join("secret");
            fs::write(&path, content).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            let text = format!("version = 1\n[access.a]\nrole = 'viewer'\n{key} = '{}'\n", path.display());
            let source = SourceText::new("c.toml", &text);
            let settings: Settings = toml::from_str(&text).unwrap();
            let warnings = check(&source, &settings);
            warnings.iter().map(ToString::to_string).collect::<String>()
        };
        assert_eq!(said("token_file", b"0123456789abcdef\n", 0o640), "");
        assert_eq!(said("password_file", hash.as_bytes(), 0o600), "");
        for (key, content, mode, says) in [
            ("token_file", &b"canary"[..], 0o600, "a token has 16 bytes or more"),
            ("token_file", b"0123456789abcdef", 0o644, "everybody on this host can read or write"),
            ("password_file", b"canary-canary-canary", 0o600, "this is no Argon2id hash"),
            ("password_file", b"canary\xFF", 0o600, "it is no text"),
        ] {
            let said = said(key, content, mode);
            assert!(said.starts_with("c.toml:4:") && said.contains(says), "{said}");
            assert!(!said.contains("canary"), "{said}");
        }
        let text = "version = 1\n[access.a]\nrole = 'viewer'\ntoken_file = '/nowhere/token'\n";
        let warnings = check(&SourceText::new("c.toml", text), &toml::from_str(text).unwrap());
        assert!(warnings[0].to_string().contains("cannot read `/nowhere/token`"), "{warnings:?}");
    }
}
