//! What is wrong with a file of certificates or keys, and how to mend it.

/// Why files cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TlsError {
    /// The system does not let it be read.
    #[error("cannot read `{file}`: {error}; check the path and its permissions")]
    Unreadable {
        /// As configured.
        file: String,
        /// What the system says.
        error: String,
    },
    /// No file of certificates is that large.
    #[error("`{file}` is larger than {limit} bytes: that is no file of certificates")]
    TooLarge {
        /// As configured.
        file: String,
        /// In bytes.
        limit: u64,
    },
    /// It has nothing of what is looked for.
    #[error("`{file}` holds no {what} in PEM form, which begins with `-----BEGIN {label}-----`; {hint}")]
    Nothing {
        /// As configured.
        file: String,
        /// `certificate`, `private key`.
        what: &'static str,
        /// Of the PEM section.
        label: &'static str,
        /// What it may be instead, and how to mend that.
        hint: &'static str,
    },
    /// It begins well and cannot be read to its end.
    #[error("the {what} in `{file}` is damaged: {error}; copy the whole file again")]
    Damaged {
        /// As configured.
        file: String,
        /// `certificate`, `private key`.
        what: &'static str,
        /// What is wrong.
        error: String,
    },
    /// A key of a kind that is not used.
    #[error(
        "the private key in `{file}` cannot be used: {error}; RSA of 2048 to 8192 bits, ECDSA on P-256 or P-384, and Ed25519 can"
    )]
    Kind {
        /// As configured.
        file: String,
        /// What is wrong.
        error: String,
    },
    /// Certificate and key do not belong together.
    #[error(
        "the private key in `{key_file}` does not belong to the certificate in `{cert_file}`: put the pair that was made together there"
    )]
    Mismatch {
        /// As configured.
        cert_file: String,
        /// As configured.
        key_file: String,
    },
    /// The host trusts nobody.
    #[error(
        "this host has no certification authorities to trust{error}; install ca-certificates, or set `ca_file`"
    )]
    NoAuthorities {
        /// What was wrong, with a colon before it.
        error: String,
    },
    /// A new certificate that is not valid now, while the one before is.
    #[error("the certificate in `{file}` is not taken up: {complaint}")]
    NotValid {
        /// As configured.
        file: String,
        /// About its dates.
        complaint: String,
    },
    /// The library refuses it.
    #[error("TLS cannot be set up: {0}")]
    Refused(String),
}
