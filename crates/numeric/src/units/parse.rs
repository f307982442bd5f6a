//! The one parser behind every quantity.

use crate::units::Quantity;
use core::fmt;

/// The error of a text that should be a quantity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnitProblem {
    /// Nothing was written.
    Empty,
    /// No number at the start.
    NotANumber,
    /// The number is infinite, not a number, or overflows.
    NotFinite,
    /// A number without a unit.
    NoUnit,
    /// A unit that does not belong to this quantity.
    WrongUnit,
}

/// A text that is not the expected quantity; its message says what to write instead.
///
/// Holds the first characters of the text (at most 23 bytes), so that the message can repeat the number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnitError {
    /// What is wrong.
    pub problem: UnitProblem,
    noun: &'static str,
    base: &'static str,
    symbols: &'static str,
    number: Excerpt,
    unit: Excerpt,
}

const EXCERPT: usize = 23;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Excerpt {
    bytes: [u8; EXCERPT],
    len: u8,
}

impl Excerpt {
    fn new(text: &str) -> Self {
        let mut len = text.len().min(EXCERPT);
        while !text.is_char_boundary(len) {
            len -= 1;
        }
        let mut bytes = [0; EXCERPT];
        bytes[..len].copy_from_slice(&text.as_bytes()[..len]);
        Self {
            bytes,
            len: len as u8,
        }
    }

    fn text(&self) -> &str {
        core::str::from_utf8(&self.bytes[..usize::from(self.len)]).unwrap_or("")
    }
}

impl fmt::Display for UnitError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (noun, base, symbols) = (self.noun, self.base, self.symbols);
        let (number, unit) = (self.number.text(), self.unit.text());
        match self.problem {
            UnitProblem::Empty => write!(
                f,
                "{noun} is missing: write for example 1{base} ({symbols})"
            ),
            UnitProblem::NotANumber => write!(
                f,
                "`{number}{unit}` is not {noun}: write a number and a unit, for example 1{base} ({symbols})"
            ),
            UnitProblem::NotFinite => write!(
                f,
                "{noun} must be finite: write a number and a unit, for example 1{base} ({symbols})"
            ),
            UnitProblem::NoUnit => write!(
                f,
                "{noun} needs a unit: write for example {number}{base} ({symbols})"
            ),
            UnitProblem::WrongUnit => write!(
                f,
                "`{unit}` is not a unit of {noun}: write for example {number}{base} ({symbols})"
            ),
        }
    }
}

impl core::error::Error for UnitError {}

/// Length in bytes of the longest prefix that reads as a decimal number: sign, digits, point, exponent.
fn number_prefix(text: &str) -> usize {
    let bytes = text.as_bytes();
    let mut at = 0;
    if matches!(bytes.first(), Some(b'+' | b'-')) {
        at = 1;
    }
    let digits = |from: usize| {
        bytes[from..]
            .iter()
            .take_while(|b| b.is_ascii_digit())
            .count()
    };
    let whole = digits(at);
    at += whole;
    let mut fraction = 0;
    if bytes.get(at) == Some(&b'.') {
        fraction = digits(at + 1);
        at += 1 + fraction;
    }
    if whole + fraction == 0 {
        return 0;
    }
    if matches!(bytes.get(at), Some(b'e' | b'E')) {
        let mut after = at + 1;
        if matches!(bytes.get(after), Some(b'+' | b'-')) {
            after += 1;
        }
        let exponent = digits(after);
        if exponent > 0 {
            at = after + exponent;
        }
    }
    at
}

pub(crate) fn parse(text: &str, quantity: &Quantity) -> Result<f64, UnitError> {
    let text = text.trim();
    let (number, unit) = text.split_at(number_prefix(text));
    let unit = unit.trim_start();
    let fail = |problem| UnitError {
        problem,
        noun: quantity.noun,
        base: quantity.base,
        symbols: quantity.symbols,
        number: Excerpt::new(number),
        unit: Excerpt::new(unit),
    };
    if text.is_empty() {
        return Err(fail(UnitProblem::Empty));
    }
    let lower_is = |word: &str| {
        unit.trim_start_matches(['+', '-'])
            .eq_ignore_ascii_case(word)
    };
    if number.is_empty() && (lower_is("nan") || lower_is("inf") || lower_is("infinity")) {
        return Err(fail(UnitProblem::NotFinite));
    }
    let value: f64 = number.parse().map_err(|_| fail(UnitProblem::NotANumber))?;
    if unit.is_empty() {
        return Err(fail(UnitProblem::NoUnit));
    }
    let factor = quantity
        .units
        .iter()
        .find(|candidate| candidate.symbol == unit)
        .ok_or_else(|| fail(UnitProblem::WrongUnit))?
        .factor;
    // Dividing by a power of ten rounds once where multiplying by its inverse rounds twice: 250nm is 0.25um exactly.
    let value = if factor < 1.0 {
        value / rounded_reciprocal(factor)
    } else {
        value * factor
    };
    if value.is_finite() {
        Ok(value)
    } else {
        Err(fail(UnitProblem::NotFinite))
    }
}

/// The whole number nearest to `1 / factor` for the sub-unit factors of this crate (all are 10^-n).
fn rounded_reciprocal(factor: f64) -> f64 {
    (1.0 / factor + 0.5) as u64 as f64
}

#[cfg(test)]
mod tests {
    use crate::units::{Degrees, Hertz, Micrometers, MicrometersPerSecond, Seconds, UnitProblem};
    use std::format;
    use std::string::ToString;

    #[test]
    fn every_unit_of_the_issue_is_read_exactly() {
        assert_eq!("0um".parse(), Ok(Micrometers(0.0)));
        assert_eq!("-250nm".parse(), Ok(Micrometers(-0.25)));
        assert_eq!("1.5ms".parse(), Ok(Seconds(0.0015)));
        assert_eq!("2Hz".parse(), Ok(Hertz(2.0)));
        assert_eq!("1.5 kHz".parse(), Ok(Hertz(1500.0)));
        assert_eq!(" +3e-1 µm ".parse(), Ok(Micrometers(0.3)));
        assert_eq!(".5um".parse(), Ok(Micrometers(0.5)));
        assert_eq!("2um/ms".parse(), Ok(MicrometersPerSecond(2000.0)));
        assert_eq!("90deg".parse(), Ok(Degrees(90.0)));
        assert_eq!("10min".parse(), Ok(Seconds(600.0)));
    }

    #[test]
    fn a_bare_number_is_refused_and_the_message_says_what_to_write() {
        let error = "5".parse::<Micrometers>().unwrap_err();
        assert_eq!(error.problem, UnitProblem::NoUnit);
        assert!(error.to_string().contains("5um"), "{error}");
    }

    #[test]
    fn a_wrong_unit_names_itself_and_the_right_ones() {
        let error = "5V".parse::<Micrometers>().unwrap_err();
        assert_eq!(error.problem, UnitProblem::WrongUnit);
        assert_eq!(
            error.to_string(),
            "`V` is not a unit of a length: write for example 5um (nm, um, mm, m)"
        );
        assert!(
            "5UM".parse::<Micrometers>().is_err(),
            "units are case-sensitive: MHz is not mHz"
        );
    }

    #[test]
    fn nan_infinity_overflow_and_nonsense_are_refused() {
        for (text, problem) in [
            ("", UnitProblem::Empty),
            ("NaNum", UnitProblem::NotANumber),
            ("nan", UnitProblem::NotFinite),
            ("-inf", UnitProblem::NotFinite),
            ("1e999um", UnitProblem::NotFinite),
            ("um", UnitProblem::NotANumber),
            ("--1um", UnitProblem::NotANumber),
            ("1.2.3um", UnitProblem::WrongUnit),
            ("1e", UnitProblem::WrongUnit),
        ] {
            assert_eq!(
                text.parse::<Micrometers>().unwrap_err().problem,
                problem,
                "{text:?}"
            );
        }
    }

    #[test]
    fn display_reads_back_to_the_same_value() {
        let mut random = crate::Random::new(1);
        for _ in 0..10_000 {
            let value = (random.uniform() - 0.5) * 1e6;
            assert_eq!(
                format!("{}", Micrometers(value)).parse(),
                Ok(Micrometers(value))
            );
        }
        assert_eq!(format!("{:.2}", Seconds(1.0 / 3.0)), "0.33s");
    }

    #[test]
    fn a_long_text_in_an_error_is_cut_at_a_character() {
        let error = "1µµµµµµµµµµµµµµµµµµµµµµµ"
            .parse::<Micrometers>()
            .unwrap_err();
        assert!(error.to_string().starts_with("`µ"));
    }
}
