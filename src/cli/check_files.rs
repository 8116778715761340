//! What `check` says of the files that a configuration names: certificates and keys \[IO\].

use super::check_secrets;
use crate::config::Settings;
use crate::mapping::{Diagnostic, SourceText, locate};
use crate::time::Clock;
use crate::tls::TlsError;
use crate::tls::files::{Loaded, load_client, load_server};

/// Warnings, as the files are those of the computer where the gateway runs, and this may be another one.
pub(super) fn check(source: &SourceText, settings: &Settings) -> Vec<Diagnostic> {
    let mut warnings = Vec::new();
    let mut tell = |place: [&str; 2], texts: Vec<String>| {
        let hint = "the gateway reads these files, so they have to be right where it runs";
        warnings.extend(texts.into_iter().map(|text| source.warning(&locate(source, &place), text, hint)));
    };
    if let Some(mqtt) = settings.mqtt.as_ref().filter(|mqtt| mqtt.url.tls) {
        tell(["mqtt", "tls"], told(load_client(&mqtt.tls)));
    }
    let security = &settings.modbus.security;
    if !security.is_off() {
        tell(["modbus", "security"], told(load_server(&security.tls(), None)));
    }
    if let Some(tls) = settings.http.tls.files() {
        tell(["http", "tls"], told(load_server(&tls, None)));
    }
    warnings.extend(check_secrets::check(source, settings));
    warnings
}

fn told<C>(loaded: Result<Loaded<C>, TlsError>) -> Vec<String> {
    match loaded {
        Err(error) => vec![error.to_string()],
        Ok(Loaded { own, mut warnings, .. }) => {
            let now = Clock::start().now().utc;
            warnings.extend(own.and_then(|(file, own)| {
                own.complaint(now).map(|complaint| format!("`{}`: {complaint}", file.display()))
            }));
            warnings
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_cannot_be_used_here_are_warned_of_where_they_are_named() {
        let text = "version = 1\n[mqtt]\nurl = 'mqtts://broker'\n[mqtt.tls]\nca_file = '/nowhere/ca.pem'\n\
                    [modbus.security]\nlisten = ['127.0.0.1:802']\ncert_file = '/nowhere/c'\nkey_file = '/nowhere/k'\n\
                    client_ca_file = '/nowhere/a'\n[http.tls]\ncert_file = '/nowhere/h'\nkey_file = '/nowhere/k'\n";
        let source = SourceText::new("cangate.toml", text);
        let settings: Settings = toml::from_str(text).unwrap();
        let warnings: Vec<String> = check(&source, &settings).iter().map(ToString::to_string).collect();
        assert_eq!(warnings.len(), 3, "{warnings:?}");
        assert!(
            warnings[0].starts_with("cangate.toml:4:1: warning: cannot read `/nowhere/ca.pem`"),
            "{warnings:?}"
        );
        assert!(
            warnings[1].starts_with("cangate.toml:6:1: warning: cannot read `/nowhere/c`"),
            "{warnings:?}"
        );
        assert!(
            warnings[2].starts_with("cangate.toml:11:1: warning: cannot read `/nowhere/h`"),
            "{warnings:?}"
        );
        let plain: Settings = toml::from_str("version = 1\n[mqtt]\n").unwrap();
        assert_eq!(check(&source, &plain), []);
    }
}
