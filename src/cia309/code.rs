//! The error codes of CiA 309-3, as far as this gateway answers them. Abort codes of SDO transfers are answered as they came.

use std::fmt;

/// Why a request is not done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// The code.
    pub code: Code,
    /// What a person should know; one line, may be empty.
    pub text: String,
}

/// A code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// 100: the request is not supported, or not allowed here.
    NotSupported,
    /// 101: syntax error.
    Syntax,
    /// 102: the request cannot be done in the present state.
    State,
    /// 104: no network was given and none is set.
    NoNetwork,
    /// 105: no node was given and none is set.
    NoNode,
    /// 106: there is no such network.
    UnknownNetwork,
    /// 107: there is no such node.
    UnknownNode,
    /// 600: more than there is room for.
    TooLong,
    /// The abort code of an SDO transfer.
    Abort(u32),
}

impl Code {
    /// SDO time-out: the node did not answer.
    pub const SDO_TIMEOUT: Self = Self::Abort(0x0504_0000);
    /// The object has another length than its type.
    pub const LENGTH: Self = Self::Abort(0x0607_0010);

    /// With a text for people.
    #[must_use]
    pub fn because(self, text: impl Into<String>) -> Refusal {
        Refusal { code: self, text: text.into() }
    }
}

impl fmt::Display for Code {
    /// `101`, or `0x06020000`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let number = match self {
            Self::NotSupported => 100,
            Self::Syntax => 101,
            Self::State => 102,
            Self::NoNetwork => 104,
            Self::NoNode => 105,
            Self::UnknownNetwork => 106,
            Self::UnknownNode => 107,
            Self::TooLong => 600,
            Self::Abort(code) => return write!(f, "0x{code:08X}"),
        };
        write!(f, "{number}")
    }
}

impl fmt::Display for Refusal {
    /// `ERROR:101 #what is wrong`: a program reads the number, and the rest is a comment by the rules of the standard.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ERROR:{}", self.code)?;
        if self.text.is_empty() { Ok(()) } else { write!(f, " #{}", self.text) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_is_a_code_and_a_comment() {
        assert_eq!(Code::Syntax.because("no such command").to_string(), "ERROR:101 #no such command");
        assert_eq!(Code::Abort(0x0602_0000).because("").to_string(), "ERROR:0x06020000");
    }
}
