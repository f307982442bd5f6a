//! The operator's requests from the page.

use serde::Deserialize;

/// Longest note, characters.
const NOTE_CHARACTERS: usize = 500;

/// A request of the operator.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "kebab-case")]
pub enum OperatorRequest {
    /// Stop the bead.
    Freeze,
    /// Continue after a freeze or a pause.
    Resume,
    /// Ramp to park: the run ends.
    Park,
    /// Stop the script's clock and the bead.
    Pause,
    /// Continue with the script's next step.
    Skip,
    /// A new target.
    Target {
        /// Position along the channel, um.
        um: f64,
    },
    /// A note into the run's events.
    Note {
        /// Its text, without control characters.
        text: String,
    },
}

/// A request that cannot be carried out.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CommandError {
    /// Not a request.
    #[error("not a request: {0}")]
    Unreadable(String),
    /// A target that is not a position in view.
    #[error("target {0} is outside what can be asked for ({1} um to {2} um)")]
    OutOfView(String, String, String),
    /// A note without text, or too long.
    #[error("a note has 1 to 500 characters")]
    Note,
    /// A viewer asked.
    #[error("this link may look only; the operator's link may act")]
    ViewerOnly,
}

impl OperatorRequest {
    /// Reads a request. `targets_um` bounds targets if known.
    ///
    /// # Errors
    /// [`CommandError`], for an answer to the client.
    pub fn read(text: &str, targets_um: [f64; 2]) -> Result<Self, CommandError> {
        let command: Self =
            serde_json::from_str(text).map_err(|e| CommandError::Unreadable(e.to_string()))?;
        match command {
            Self::Target { um } => {
                let [low, high] = targets_um;
                // Comparisons with an unknown end (NaN) are false, so any finite target is accepted then.
                if !um.is_finite() || um < low || um > high || um.abs() > 1e6 {
                    return Err(CommandError::OutOfView(
                        um.to_string(),
                        low.to_string(),
                        high.to_string(),
                    ));
                }
                Ok(Self::Target { um })
            }
            Self::Note { text } => {
                let text: String = text.chars().filter(|c| !c.is_control()).collect();
                let length = text.chars().count();
                if text.trim().is_empty() || length > NOTE_CHARACTERS {
                    return Err(CommandError::Note);
                }
                Ok(Self::Note { text })
            }
            other => Ok(other),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const VIEW: [f64; 2] = [-12.8, 12.8];

    #[test]
    fn requests_are_read_and_bounded() {
        let read = |text| OperatorRequest::read(text, VIEW);
        assert_eq!(read(r#"{"do":"freeze"}"#), Ok(OperatorRequest::Freeze));
        assert_eq!(
            read(r#"{"do":"target","um":-3.5}"#),
            Ok(OperatorRequest::Target { um: -3.5 })
        );
        assert!(matches!(
            read(r#"{"do":"target","um":13}"#),
            Err(CommandError::OutOfView(..))
        ));
        assert!(matches!(
            read(r#"{"do":"target","um":1e999}"#),
            Err(CommandError::Unreadable(_) | CommandError::OutOfView(..))
        ));
        assert!(read(r#"{"do":"arm"}"#).is_err());
        // A stop is executed with any other content.
        assert_eq!(
            read(r#"{"do":"park","now":true}"#),
            Ok(OperatorRequest::Park)
        );
        assert!(OperatorRequest::read(r#"{"do":"target","um":13}"#, [f64::NAN; 2]).is_ok());
    }

    #[test]
    fn a_note_loses_control_characters_and_has_an_end() {
        let note = OperatorRequest::read("{\"do\":\"note\",\"text\":\"a\\u001b[31mb\"}", VIEW);
        assert_eq!(
            note,
            Ok(OperatorRequest::Note {
                text: "a[31mb".to_string()
            })
        );
        let long = format!("{{\"do\":\"note\",\"text\":\"{}\"}}", "x".repeat(501));
        assert_eq!(OperatorRequest::read(&long, VIEW), Err(CommandError::Note));
    }
}
