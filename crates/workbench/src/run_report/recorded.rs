//! A run as it was read from its folder.

use super::session::Session;
use super::ticks::Ticks;
use super::{bound, fatigue, origin};
use cellpos_record::{CYCLES_CSV, RunReader};
use cellpos_script::{ReadCycles, read_cycles};
use cellpos_session::Failure;
use cellpos_session::sessions::{self, session_config};
use std::path::Path;

/// A run as it was read, all its sessions together.
pub(super) struct Recorded {
    pub(super) sessions: Vec<Session>,
    pub(super) ticks: Ticks,
    pub(super) cycles: ReadCycles,
    pub(super) first: RunReader,
}

impl Recorded {
    pub(super) fn open(run: &Path) -> Result<Self, Failure> {
        let first = RunReader::open(run).map_err(Failure::input)?;
        let text = std::fs::read_to_string(run.join(CYCLES_CSV)).unwrap_or_default();
        let cycles = read_cycles(&text);
        let mut ticks = Ticks::with_courses(fatigue::courses(&cycles.rows));
        let mut sessions = Vec::new();
        for folder in sessions::of(run) {
            let reader = RunReader::open(&folder).map_err(Failure::input)?;
            let gap_s = session_config(&reader).and_then(|config| config.gap_s);
            let start_s = if sessions.is_empty() {
                0.0
            } else {
                ticks.end_s() + gap_s.unwrap_or(0.0)
            };
            let mut batches = reader.batches().map_err(Failure::failed)?;
            ticks.begin(start_s, reader.meta().ok().and_then(bound::hold_of));
            for batch in batches.by_ref() {
                batch.iter().for_each(|record| ticks.add(record));
            }
            sessions.push(Session {
                lost: batches.lost(),
                events: reader.events().map_err(Failure::failed)?.events,
                of_a_cell: reader.meta().is_ok_and(origin::is_cell),
                meta: reader.meta().ok().cloned(),
                folder,
                start_s,
            });
        }
        Ok(Self {
            sessions,
            ticks,
            cycles,
            first,
        })
    }

    pub(super) fn name(&self) -> &str {
        self.first.meta().map_or("run", |meta| meta.name.as_str())
    }
}
