//! What stands in a certificate (X.509, RFC 5280): whose it is, from when, until when.

use x509_parser::prelude::{FromDer, X509Certificate};

use crate::time::Timestamp;

const SECONDS_PER_DAY: i64 = 86_400;

/// A certificate, as far as people want to know of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Certificate {
    /// Its subject: `CN=gateway.plant.example`.
    pub subject: String,
    /// Valid from then on.
    pub not_before: Timestamp,
    /// Valid until then.
    pub not_after: Timestamp,
}

/// Whether a certificate is valid at a moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Validity {
    /// Later.
    NotYet,
    /// Yes.
    Valid,
    /// No longer.
    Expired,
}

impl Certificate {
    /// Reads one.
    ///
    /// # Errors
    /// What is wrong with the bytes.
    pub fn read(der: &[u8]) -> Result<Self, String> {
        let (_, certificate) = X509Certificate::from_der(der).map_err(|error| error.to_string())?;
        let moment = |time: x509_parser::time::ASN1Time| {
            Timestamp::from_millis(time.timestamp().saturating_mul(1_000))
        };
        Ok(Self {
            subject: certificate.subject().to_string(),
            not_before: moment(certificate.validity().not_before),
            not_after: moment(certificate.validity().not_after),
        })
    }

    /// Whether it is valid at a moment.
    #[must_use]
    pub fn validity(&self, now: Timestamp) -> Validity {
        if now < self.not_before {
            Validity::NotYet
        } else if now > self.not_after {
            Validity::Expired
        } else {
            Validity::Valid
        }
    }

    /// Whole days until it expires; negative once it has.
    #[must_use]
    pub fn days_left(&self, now: Timestamp) -> i64 {
        days_left(now, self.not_after)
    }

    /// What people have to know of its dates: that it has expired, or is not valid yet.
    #[must_use]
    pub fn complaint(&self, now: Timestamp) -> Option<String> {
        let Self { subject, .. } = self;
        match self.validity(now) {
            Validity::Valid => None,
            Validity::Expired => Some(format!("`{subject}` has expired on {}", date(self.not_after))),
            Validity::NotYet => Some(format!(
                "`{subject}` is not valid before {}; is the clock of this host right?",
                date(self.not_before)
            )),
        }
    }
}

/// Whole days until a certificate expires; negative once it has.
#[must_use]
pub fn days_left(now: Timestamp, not_after: Timestamp) -> i64 {
    (not_after.as_secs() - now.as_secs()).div_euclid(SECONDS_PER_DAY)
}

/// A moment for people, to the second.
#[must_use]
pub fn date(moment: Timestamp) -> String {
    jiff::Timestamp::from_second(moment.as_secs())
        .map_or_else(|_| moment.as_secs().to_string(), |moment| moment.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAY: i64 = SECONDS_PER_DAY * 1000;

    #[test]
    fn g06_days_are_whole_and_negative_once_it_has_expired() {
        let certificate = Certificate {
            subject: "CN=x".into(),
            not_before: Timestamp::from_millis(0),
            not_after: Timestamp::from_millis(30 * DAY),
        };
        let at = |millis| {
            let now = Timestamp::from_millis(millis);
            (certificate.days_left(now), certificate.validity(now))
        };
        assert_eq!(at(-1), (30, Validity::NotYet));
        assert_eq!(at(0), (30, Validity::Valid));
        assert_eq!(at(1000), (29, Validity::Valid));
        assert_eq!(at(30 * DAY), (0, Validity::Valid));
        assert_eq!(at(30 * DAY + 1000), (-1, Validity::Expired));
        let complaint = certificate.complaint(Timestamp::from_millis(31 * DAY)).unwrap();
        assert_eq!(complaint, "`CN=x` has expired on 1970-01-31T00:00:00Z");
    }

    #[test]
    fn dates_and_subject_are_read_and_bytes_that_are_no_certificate_are_an_error() {
        let mut settings = rcgen::CertificateParams::new(vec!["gateway".to_owned()]).unwrap();
        settings.distinguished_name.push(rcgen::DnType::CommonName, "gateway");
        settings.not_before = rcgen::date_time_ymd(2026, 1, 2);
        settings.not_after = rcgen::date_time_ymd(2027, 1, 2);
        let der = settings.self_signed(&rcgen::KeyPair::generate().unwrap()).unwrap();
        let read = Certificate::read(der.der()).unwrap();
        assert!(read.subject.contains("CN=gateway"), "{}", read.subject);
        assert_eq!(
            [read.not_before, read.not_after].map(date),
            ["2026-01-02T00:00:00Z", "2027-01-02T00:00:00Z"]
        );
        for length in [0, 1, 10, der.der().len() - 1] {
            assert!(Certificate::read(&der.der()[..length]).is_err());
        }
    }
}
