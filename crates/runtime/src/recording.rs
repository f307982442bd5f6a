//! How the recording of a run went.

use serde::Serialize;
use std::time::Duration;

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
    /// The disk took what was written and has not confirmed it for [`Unconfirmed::LIMIT`].
    Unconfirmed = 5,
}

impl RecorderFault {
    pub(crate) fn from_number(number: u8) -> Option<Self> {
        [
            Self::Panicked,
            Self::Refused,
            Self::Behind,
            Self::Stuck,
            Self::Unconfirmed,
        ]
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
            Self::Unconfirmed => {
                "the disk had not confirmed what was written for 5 s: all of it was in memory only; the bead was frozen and the \
                 PZT parked"
            }
            Self::Behind => {
                "the disk was so slow that the recorder fell behind by half of its memory; the bead was frozen and the PZT \
                 parked before records were lost"
            }
        }
    }
}

/// Data that a sink has taken and cannot promise to keep: the disk has not confirmed it. A program that dies loses nothing of what was
/// written, but a power failure would.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Unconfirmed {
    /// How long the disk has not answered any request to confirm it; zero if no request is open.
    pub since: Duration,
    /// Rows.
    pub rows: u64,
}

impl Unconfirmed {
    /// A wait that is said: a sync of half a second is a slow disk that does its work.
    pub const SAID: Duration = Duration::from_millis(900);
    /// A wait that ends the run. A file system leaves data unwritten for as long if no program asks it to sync (the commit interval of ext4
    /// is 5 s), and a busy disk commits its journal in half of that.
    pub const LIMIT: Duration = Duration::from_secs(5);
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
    /// The longest that the disk left what was written unconfirmed, ms; zero where it was never asked.
    pub unconfirmed_ms: u64,
}
