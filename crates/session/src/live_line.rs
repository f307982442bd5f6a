//! The line of a run on the terminal. The most important part comes first; parts without room are left out.

use cellpos_runtime::{Life, Statistics, TickFlags, TickRecord};
use std::sync::{Arc, Mutex, PoisonError};

/// Data of the live line.
#[derive(Debug, Clone, Default)]
pub struct LiveLine {
    /// Smallest displacement, um.
    pub low_um: f64,
    /// Largest displacement, um.
    pub high_um: f64,
    /// The keys and their actions; empty: no keys.
    pub keys: &'static str,
    /// Number that the operator is typing.
    pub typed: Typed,
}

/// The typed number, shared by the threads of keys and line; neither is real-time.
#[derive(Debug, Clone, Default)]
pub struct Typed(Arc<Mutex<String>>);

impl Typed {
    /// Replaces the text.
    pub fn set(&self, text: &str) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = text.to_string();
    }

    /// Content.
    pub fn text(&self) -> String {
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }
}

/// A part of a line: its rank (without room, the largest rank is left out first) and its text.
type Part = (u8, String);

impl LiveLine {
    /// The line for a terminal of this width.
    pub fn text(
        &self,
        record: &TickRecord,
        statistics: &Statistics,
        late: u64,
        columns: usize,
    ) -> String {
        let state = Life::from_number(record.life).map_or("?", Life::name);
        let error_nm = record.error_um * 1e3;
        let to_limit_um = (record.command_um - self.low_um).min(self.high_um - record.command_um);
        let mut parts: Vec<Part> = vec![
            (4, format!("{:.2}s", record.time_ns as f64 * 1e-9)),
            (0, state.to_string()),
        ];
        // Before the first position there is no error.
        if error_nm.is_finite() {
            parts.push((0, format!("error {error_nm:+.0}nm")));
        }
        if let Some(rms_nm) = statistics.rms_measured_nm() {
            parts.push((3, format!("rms {rms_nm:.1}nm")));
        }
        parts.push((5, format!("target {:+.3}um", record.target_um)));
        if record.measured_um.is_finite() {
            parts.push((6, format!("bead {:+.3}um", record.measured_um)));
        }
        parts.push((1, format!("PZT {:.2}um", record.command_um)));
        if record.flags.has(TickFlags::PARTNER_LOST) {
            parts.push((1, "slow actuator MISSING".to_string()));
        } else if record.partner_command_um.is_finite() {
            parts.push((2, format!("slow {:.2}um", record.partner_command_um)));
        }
        parts.push((7, format!("({to_limit_um:.1}um to limit)")));
        parts.push((if late > 0 { 2 } else { 8 }, format!("late {late}")));
        let typed = self.typed.text();
        if !typed.is_empty() {
            parts.push((0, format!("target: {typed}_")));
        } else if !self.keys.is_empty() {
            parts.push((9, self.keys.to_string()));
        }
        fit(parts, columns)
    }
}

/// The parts side by side, without those that have no room.
fn fit(mut parts: Vec<Part>, columns: usize) -> String {
    loop {
        let line = parts
            .iter()
            .map(|(_, text)| text.as_str())
            .collect::<Vec<_>>()
            .join("  ");
        if line.chars().count() < columns {
            return line;
        }
        let least = (0..parts.len()).max_by_key(|&n| parts[n].0);
        match least {
            Some(n) if parts[n].0 > 0 => drop(parts.remove(n)),
            // The cursor needs a column after the line.
            _ => return line.chars().take(columns.saturating_sub(1)).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(columns: usize, typed: &str) -> String {
        let line = LiveLine {
            low_um: 0.0,
            high_um: 40.0,
            keys: "f freeze, q stop",
            typed: Typed::default(),
        };
        line.typed.set(typed);
        let record = TickRecord {
            time_ns: 12_345_600_000_000,
            measured_um: -12.3456,
            target_um: -11.0,
            error_um: -0.3456,
            command_um: 31.234,
            life: Life::Running as u8,
            ..TickRecord::unknown()
        };
        line.text(&record, &Statistics::default(), 0, columns)
    }

    #[test]
    fn a_line_without_a_position_has_no_numbers_for_it() {
        let line = LiveLine {
            low_um: 0.0,
            high_um: 40.0,
            keys: "",
            typed: Typed::default(),
        };
        let record = TickRecord {
            life: Life::Armed as u8,
            target_um: 0.0,
            command_um: 20.0,
            ..TickRecord::unknown()
        };
        let text = line.text(&record, &Statistics::default(), 0, 200);
        assert!(text.contains("armed") && !text.contains("NaN"), "{text}");
    }

    #[test]
    fn the_line_fits_any_width_and_what_matters_stays() {
        for columns in 1..250 {
            assert!(line(columns, "").chars().count() < columns.max(1) + usize::from(columns == 0));
        }
        let narrow = line(40, "");
        assert!(
            narrow.contains("running") && narrow.contains("error -346nm"),
            "{narrow}"
        );
        assert!(narrow.contains("PZT 31.23um"), "{narrow}");
        let wide = line(200, "");
        for part in ["(8.8um to limit)", "late 0", "f freeze", "bead -12.346um"] {
            assert!(wide.contains(part), "{wide}");
        }
    }

    #[test]
    fn what_is_typed_stands_in_place_of_the_keys() {
        let typed = line(60, "-2.5");
        assert!(
            typed.contains("target: -2.5_") && !typed.contains("freeze"),
            "{typed}"
        );
    }
}
