//! Why a value should not be used as it stands: one answer for registers, topics and pages.

use super::TagDef;
use crate::process_image::{ProcessImage, Reason, Sample};

/// Why a value should not be used as it stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Objection {
    /// Its own quality is not good, or that of the tag that tells whether it means anything.
    Quality(Reason),
    /// Its own device says that it means nothing: the tag that tells so is good and false (R-DET-086).
    NotValid,
    /// Its own device has a reservation, such as a value outside its range (R-DST-026).
    Doubtful,
}

impl Objection {
    /// The word in payloads and pages.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Quality(reason) => reason.word(),
            Self::NotValid => "not_valid",
            Self::Doubtful => "doubtful",
        }
    }
}

impl TagDef {
    /// What is to be said against a sample of this tag; `None` for one that is good and that its device vouches for.
    #[must_use]
    pub fn objection(&self, image: &ProcessImage, sample: &Sample) -> Option<Objection> {
        let own = sample.quality.reason().map(Objection::Quality);
        own.or_else(|| self.disowned(image)).or_else(|| self.doubted(image))
    }

    /// What its device says against the value, or that what would say so cannot be trusted.
    fn doubted(&self, image: &ProcessImage) -> Option<Objection> {
        let doubt = image.tag(self.doubtful?);
        let unknown = doubt.quality.reason().map(Objection::Quality);
        unknown.or_else(|| doubt.value.is_true().then_some(Objection::Doubtful))
    }

    /// Why its device does not vouch for the value, whatever its own quality.
    #[must_use]
    pub fn disowned(&self, image: &ProcessImage) -> Option<Objection> {
        let validity = image.tag(self.valid?);
        match validity.quality.reason() {
            Some(reason) => Some(Objection::Quality(reason)),
            None if validity.value.is_true() => None,
            None => Some(Objection::NotValid),
        }
    }
}
