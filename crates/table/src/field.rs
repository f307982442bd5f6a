//! Fields of a CSV file for writing.

use std::borrow::Cow;

/// A text as a field of a CSV file. If it contains a separator, or begins or ends with a blank, it is quoted and its own quotes
/// are doubled.
///
/// ```
/// use cellpos_table::csv_field;
/// assert_eq!(csv_field("T [degC]"), "T [degC]");
/// assert_eq!(csv_field("6\" pipe, inside"), "\"6\"\" pipe, inside\"");
/// ```
pub fn csv_field(text: &str) -> Cow<'_, str> {
    let separates = text.contains([',', ';', '\t', '"', '\n', '\r']);
    if separates || text.trim() != text {
        Cow::Owned(format!("\"{}\"", text.replace('"', "\"\"")))
    } else {
        Cow::Borrowed(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Table;
    use std::path::Path;

    #[test]
    fn a_name_reads_back_as_it_was_written() {
        for name in [
            "T",
            "T [degC]",
            "a, b",
            "a;b",
            "6\" pipe",
            "\"",
            "x\ty",
            ", \",\" ;",
        ] {
            let text = format!("time_s,{},y\n0,1,2\n", csv_field(name));
            let table = Table::parse(Path::new("r.csv"), &text).unwrap();
            assert_eq!(table.names, ["time_s", name, "y"], "{text}");
        }
    }

    #[test]
    fn a_quote_within_a_field_is_an_inch() {
        let text = "t,5\" pipe,6 bar\n0,1,2\n";
        let table = Table::parse(Path::new("r.csv"), text).unwrap();
        assert_eq!(table.names, ["t", "5\" pipe", "6 bar"]);
    }
}
