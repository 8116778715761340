//! What MQTT 5 tells of a payload beside it, so that it can be sorted without being read. Pure.

use std::borrow::Cow;

use serde::Deserialize;

/// The members that are told.
#[derive(Deserialize)]
struct Head<'a> {
    v: Option<u64>,
    #[serde(borrow)]
    sid: Option<Cow<'a, str>>,
    seq: Option<u64>,
    historical: Option<bool>,
}

/// The user properties of a payload: `schema`, `stream`, `seq` and `historical`, each where the payload has the member `v`,
/// `sid`, `seq` or `historical`. None of what is no JSON object.
pub(super) fn labels(payload: &[u8]) -> Vec<(String, String)> {
    let Ok(Head { v, sid, seq, historical }) = serde_json::from_slice(payload) else { return Vec::new() };
    let named = [
        ("schema", v.map(|v| v.to_string())),
        ("stream", sid.map(Cow::into_owned)),
        ("seq", seq.map(|seq| seq.to_string())),
        ("historical", historical.map(|historical| historical.to_string())),
    ];
    named.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(payload: &str) -> String {
        let labels = labels(payload.as_bytes()).into_iter();
        labels.map(|(name, value)| format!("{name}={value}")).collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn labels_repeat_what_stands_in_the_payload() {
        assert_eq!(
            told(r#"{"v":1,"sid":"3f0c","seq":8,"ts":1,"kind":"alarm","value":null}"#),
            "schema=1 stream=3f0c seq=8"
        );
        assert_eq!(
            told(r#"{"v":1,"historical":true,"ts":null,"sid":"a\"b","seq":18,"tags":{"seq":5}}"#),
            "schema=1 stream=a\"b seq=18 historical=true"
        );
        assert_eq!(told(r#"{"state":"online"}"#), "");
        for none in ["", "17", "[1]", "{", r#"{"seq":-1}"#, "\u{FEFF}{}"] {
            assert_eq!(told(none), "", "{none}");
        }
    }
}
