//! How the recording of a run went.

use serde::Serialize;

/// Why a run could no longer be recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum RecorderFault {
    /// The sink panicked: a defect of this program.
    Panicked = 1,
    /// The sink could not write: a full disk, a folder that is gone.
    Refused = 2,
    /// The recorder fell behind by half of its ring: a disk that is too slow.
    Behind = 3,
    /// The sink did not come back from a call: a disk that hangs.
    Stuck = 4,
}

impl RecorderFault {
    pub(crate) fn from_number(number: u8) -> Option<Self> {
        [Self::Panicked, Self::Refused, Self::Behind, Self::Stuck]
            .into_iter()
            .find(|fault| *fault as u8 == number)
    }

    /// In a sentence.
    pub fn sentence(self) -> &'static str {
        match self {
            Self::Panicked => {
                "the recorder failed by a defect of this program; the bead was frozen and the PZT parked"
            }
            Self::Refused => {
                "the run folder could not be written for half a second; the bead was frozen and the PZT parked"
            }
            Self::Stuck => {
                "the recorder stood for 0.9 s in a write that did not come back; the bead was frozen and the PZT parked"
            }
            Self::Behind => {
                "the disk was so slow that the recorder fell behind by half of its memory; the bead was frozen and the PZT \
                 parked before records were lost"
            }
        }
    }
}

/// How the recording of a run went.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct RecorderReport {
    /// What ended it, if anything did.
    pub fault: Option<RecorderFault>,
    /// Records taken from the ring that no sink took: it had panicked.
    pub records_unkept: u64,
    /// Events likewise.
    pub events_unkept: u64,
}
