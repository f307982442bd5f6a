//! The form of a base model, stated or left to the records.

use cellpos_ident::base::{Form, FormError};
use std::str::FromStr;

/// A form as it is given on the command line: stated, or chosen by the records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Asked {
    /// By how well halves of the records predict each other.
    Chosen,
    /// As it is stated.
    Stated(Form),
}

impl FromStr for Asked {
    type Err = FormError;

    fn from_str(text: &str) -> Result<Self, FormError> {
        match text.trim() {
            "auto" => Ok(Self::Chosen),
            form => form.parse().map(Self::Stated),
        }
    }
}

impl Asked {
    /// The stated form, if there is one.
    pub fn form(self) -> Option<Form> {
        match self {
            Self::Chosen => None,
            Self::Stated(form) => Some(form),
        }
    }
}

/// Highest order that is tried where nobody states one.
pub const MOST_ORDER: usize = 4;

/// Forms that hold one thing more than another: a pole, a delay.
pub fn richer(form: Form) -> Vec<Form> {
    let delayed = Form {
        delay: true,
        ..form
    };
    let higher = Form {
        order: form.order + 1,
        zeros: None,
        ..form
    };
    let mut all = Vec::new();
    if !form.delay {
        all.push(delayed);
    }
    if higher.order <= cellpos_ident::base::MOST_ORDER {
        all.push(higher);
    }
    all
}
