//! The form of a base model, and its syntax on a command line.

use std::fmt;
use std::str::FromStr;

/// Highest order of a base model.
pub const MOST_ORDER: usize = 8;

/// The form of a base model.
///
/// ```
/// use cellpos_ident::base::Form;
/// let form: Form = "order=2,delay".parse().unwrap();
/// assert_eq!((form.order, form.delay, form.integrating), (2, true, false));
/// assert_eq!("integrating".parse::<Form>().unwrap().to_string(), "order=1,integrating");
/// assert_eq!("static".parse::<Form>().unwrap().order, 0);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Form {
    /// Poles, one at zero included.
    pub order: usize,
    /// Degree of the numerator; None leaves it to the records.
    pub zeros: Option<usize>,
    /// Whether there is a delay.
    pub delay: bool,
    /// Whether a pole is at zero.
    pub integrating: bool,
}

/// Why the text of a form is not accepted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}`: {problem}; for example order=2,delay or order=2,zeros=1 or order=1,integrating or static,delay"
)]
pub struct FormError {
    text: String,
    problem: String,
}

impl Form {
    /// Numbers of the model without the start and the zero of each record.
    pub(super) fn parameters(&self) -> usize {
        let zeros = self.zeros.unwrap_or(self.order);
        self.order + zeros + 1 + usize::from(self.delay)
    }

    /// Poles that are searched.
    pub(super) fn free_poles(&self) -> usize {
        self.order - usize::from(self.integrating)
    }
}

impl fmt::Display for Form {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.order {
            0 => write!(f, "static")?,
            order => write!(f, "order={order}")?,
        }
        if let Some(zeros) = self.zeros.filter(|_| self.order > 0) {
            write!(f, ",zeros={zeros}")?;
        }
        if self.integrating {
            write!(f, ",integrating")?;
        }
        if self.delay {
            write!(f, ",delay")?;
        }
        Ok(())
    }
}

impl FromStr for Form {
    type Err = FormError;

    fn from_str(text: &str) -> Result<Self, FormError> {
        let wrong = |problem: String| FormError {
            text: text.to_owned(),
            problem,
        };
        let (mut order, mut zeros) = (None, None);
        let (mut delay, mut integrating) = (false, false);
        for word in text.split(',').map(str::trim) {
            let (key, value) = match word.split_once('=') {
                Some((key, value)) => (key.trim(), Some(value.trim())),
                None => (word, None),
            };
            let whole = || {
                let value = value.unwrap_or("");
                let n = value.parse::<usize>().ok().filter(|n| *n <= MOST_ORDER);
                n.ok_or_else(|| wrong(format!("{key} is a whole number up to {MOST_ORDER}")))
            };
            match key {
                "order" => order = Some(whole()?),
                "zeros" => zeros = Some(whole()?),
                "static" if value.is_none() => order = Some(0),
                "delay" if value.is_none() => delay = true,
                "integrating" if value.is_none() => integrating = true,
                _ => {
                    return Err(wrong(format!(
                        "`{word}` is not one of order=N, zeros=N, static, integrating, delay"
                    )));
                }
            }
        }
        let order = match (order, integrating) {
            (Some(0), true) => return Err(wrong("a static plant does not integrate".to_owned())),
            (None, true) => 1,
            (Some(order), _) => order,
            (None, false) => return Err(wrong("the order is missing".to_owned())),
        };
        if zeros.is_some_and(|zeros| zeros > order) {
            return Err(wrong(format!(
                "a plant of order {order} has at most {order} zeros"
            )));
        }
        Ok(Self {
            order,
            zeros,
            delay,
            integrating,
        })
    }
}
