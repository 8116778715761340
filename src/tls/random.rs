//! Random bytes for secrets, from the operating system through the library of TLS.

use rustls::crypto::ring;

use super::TlsError;

/// So many random bytes.
///
/// # Errors
/// The system gives none.
pub fn bytes<const N: usize>() -> Result<[u8; N], TlsError> {
    let mut bytes = [0; N];
    let filled = ring::default_provider().secure_random.fill(&mut bytes);
    filled.map_err(|_| TlsError::Refused("the system gives no random numbers".to_owned()))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_are_alike() {
        let all: std::collections::BTreeSet<[u8; 32]> = (0..100).map(|_| bytes().unwrap()).collect();
        assert_eq!(all.len(), 100);
    }
}
