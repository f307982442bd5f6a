//! The units in which a result is told: micrometres on this rig; of other data those that their columns give.

use super::battery::Hypothesis;
use super::result::Reconciliation;

impl Reconciliation {
    /// Tells figures, places and formulas in the units of other data: `input` is that of the command, `output` that of the
    /// position. What goes by another product of the two than a plain one is told without a unit.
    pub fn tell_in(&mut self, input: &str, output: &str) {
        self.gap.unit = output.to_owned();
        let reword = |text: &mut String| *text = reworded(text, input, output);
        self.places.iter_mut().for_each(reword);
        for effect in &mut self.effects {
            let unit = match effect.place {
                "driver" | "pzt" => input,
                _ => output,
            };
            for interval in effect.parameters.values_mut() {
                if interval.unit.contains("um") {
                    interval.unit = interval.unit.replace("um", unit);
                }
            }
            effect.separate_by.iter_mut().for_each(reword);
        }
        if let Some(rest) = &mut self.remainder {
            rest.places.iter_mut().for_each(reword);
            rest.formula.iter_mut().for_each(plain);
        }
        self.hypothesis.iter_mut().for_each(plain);
    }
}

fn reworded(text: &str, input: &str, output: &str) -> String {
    text.replace(" um RMS of command", &format!(" {input} RMS of command"))
        .replace(" um ", &format!(" {output} "))
}

/// A formula without its units, which are those of micrometres on both sides.
fn plain(hypothesis: &mut Hypothesis) {
    let mut out = String::new();
    let mut rest = hypothesis.formula.as_str();
    while let Some((before, after)) = rest.split_once(" [") {
        let Some((_, behind)) = after.split_once(']') else {
            break;
        };
        out.push_str(before);
        rest = behind;
    }
    out.push_str(rest);
    hypothesis.formula = out;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sentence_is_told_in_the_units_of_the_columns() {
        let text =
            "largest in a: 0.04 um RMS of innovation beyond the floor at 1.00 um RMS of command";
        assert_eq!(
            reworded(text, "W", "degC"),
            "largest in a: 0.04 degC RMS of innovation beyond the floor at 1.00 W RMS of command"
        );
    }
}
