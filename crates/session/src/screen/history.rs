//! The data that the screen keeps of a run, bounded for any length.

use cellpos_live::{CycleRow, EventLine, Row, State};
use std::collections::VecDeque;

/// Time that the traces show, s.
pub(super) const SPAN_S: f64 = 10.0;
/// Rows that are drawn as one: a column of a wide terminal is 50 ms.
const BIN_S: f64 = 0.02;
/// Bins that are kept.
const BINS: usize = (SPAN_S / BIN_S) as usize + 2;
/// Events that are kept.
const EVENTS: usize = 100;
/// Cycles that are kept.
const CYCLES: usize = 200;

/// Some ticks: least and greatest value of each trace, so that no excursion of a single one is lost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bin {
    pub(super) time_s: f64,
    pub(super) position_um: [f64; 2],
    pub(super) target_um: [f64; 2],
    pub(super) command_um: [f64; 2],
}

const EMPTY: [f64; 2] = [f64::INFINITY, f64::NEG_INFINITY];

fn widen(range: &mut [f64; 2], value: f32) {
    // Neither holds for a NaN.
    let value = f64::from(value);
    if value < range[0] {
        range[0] = value;
    }
    if value > range[1] {
        range[1] = value;
    }
}

/// What the screen keeps.
#[derive(Debug, Default)]
pub(super) struct History {
    pub(super) bins: VecDeque<Bin>,
    pub(super) last: Option<Row>,
    pub(super) state: State,
    /// Newest first.
    pub(super) events: VecDeque<EventLine>,
    /// Newest first.
    pub(super) cycles: VecDeque<CycleRow>,
    /// The last message on the terminal.
    pub(super) said: String,
}

impl History {
    pub(super) fn row(&mut self, row: &Row) {
        let time_s = (row.time_s / BIN_S).floor() * BIN_S;
        if self.bins.back().is_none_or(|bin| bin.time_s < time_s) {
            if self.bins.len() == BINS {
                self.bins.pop_front();
            }
            self.bins.push_back(Bin {
                time_s,
                position_um: EMPTY,
                target_um: EMPTY,
                command_um: EMPTY,
            });
        }
        if let Some(bin) = self.bins.back_mut() {
            widen(&mut bin.position_um, row.measured_um);
            widen(&mut bin.target_um, row.target_um);
            widen(&mut bin.command_um, row.command_um);
        }
        self.last = Some(*row);
    }

    /// Takes the state of the run; `cell`: a cell is tracked instead of a bead.
    pub(super) fn state(&mut self, mut state: State, cell: bool) {
        state.banner.reason = words(&state.banner.reason, cell);
        state.doing = state.doing.map(|text| words(&text, cell));
        state.next = state.next.map(|text| words(&text, cell));
        self.state = state;
    }

    /// Takes an event; `cell`: a cell is tracked instead of a bead.
    pub(super) fn event(&mut self, event: EventLine, cell: bool) {
        let text = match event.text.starts_with("Note: ") || event.text.starts_with("Mark: ") {
            true => event.text,
            false => words(&event.text, cell),
        };
        self.events.push_front(EventLine { text, ..event });
        self.events.truncate(EVENTS);
    }

    pub(super) fn cycle(&mut self, cycle: CycleRow) {
        self.cycles.push_front(cycle);
        self.cycles.truncate(CYCLES);
    }
}

/// A sentence for people: units with their signs, and "cell" if a cell is tracked.
fn words(text: &str, cell: bool) -> String {
    let set = cellpos_live::terminal::for_people(text);
    if !cell {
        return set.into_owned();
    }
    (set.split_inclusive(|c: char| !c.is_alphanumeric()))
        .map(|part| {
            let word = part.trim_end_matches(|c: char| !c.is_alphanumeric());
            match word {
                "bead" => part.replacen("bead", "cell", 1),
                "Bead" => part.replacen("Bead", "Cell", 1),
                _ => part.to_string(),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_is_called_a_cell_and_a_persons_words_stay() {
        let mut history = History::default();
        let line = |text: &str| EventLine {
            time_s: 0.0,
            level: "info",
            text: text.to_string(),
        };
        history.event(line("The bead is back; beads, bead's."), true);
        history.event(line("Note: a bead of 3 um"), true);
        history.event(line("Bead lost"), false);
        let texts: Vec<_> = history.events.iter().map(|e| e.text.as_str()).collect();
        let expected = [
            "Bead lost",
            "Note: a bead of 3 um",
            "The cell is back; beads, cell's.",
        ];
        assert_eq!(texts, expected);
    }

    #[test]
    fn an_excursion_of_one_tick_is_kept_and_the_memory_is_bounded() {
        let mut history = History::default();
        for k in 0..60_000_u32 {
            history.row(&Row {
                time_s: f64::from(k) * 1e-3,
                measured_um: if k == 59_000 { 7.0 } else { 0.5 },
                ..Row::default()
            });
        }
        assert_eq!(history.bins.len(), BINS);
        let greatest = history.bins.iter().map(|bin| bin.position_um[1]);
        assert_eq!(greatest.fold(f64::NEG_INFINITY, f64::max), 7.0);
        assert!(
            history.bins.iter().all(|bin| bin.target_um == EMPTY),
            "without a target there is none"
        );
    }
}
