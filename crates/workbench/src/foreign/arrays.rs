//! Records as other programs keep them: `.npy` (NumPy) and `.mat` (MATLAB up to version 7) and text.
//!
//! Both become the text of a table, so that whatever reads a CSV file reads them, with the same messages. Not for structures,
//! cells or complex numbers, and not for version 7.3 of `.mat`, which is HDF5.

use cellpos_table::{MOST_OF_A_RECORD, read_bytes, read_text};
use std::fmt::Write as _;
use std::io;
use std::path::Path;

/// The text of a record's table: the file itself, or the content of a `.npy` or `.mat` file. In the former columns have numbers
/// (rows are samples), in the latter names: those of the variables, or `NAME_1`, `NAME_2`, ... for a variable with several columns.
///
/// # Errors
/// [`io::Error`] with a sentence.
pub fn read_table(path: &Path) -> io::Result<String> {
    let kind = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    match kind.to_ascii_lowercase().as_str() {
        "npy" => npy(&read_bytes(path, MOST_OF_A_RECORD)?),
        "mat" => mat(&read_bytes(path, MOST_OF_A_RECORD)?),
        _ => read_text(path, MOST_OF_A_RECORD),
    }
}

fn wrong(words: impl Into<String>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, words.into())
}

/// Rows of fields; what is no number is an empty field.
fn text(names: Option<&[String]>, columns: &[Vec<f64>]) -> String {
    let mut text = names.map_or_else(String::new, |names| names.join(",") + "\n");
    for k in 0..columns.first().map_or(0, Vec::len) {
        for (i, column) in columns.iter().enumerate() {
            let separator = if i == 0 { "" } else { "," };
            // Writing into a String cannot fail.
            let _ = match column[k] {
                v if v.is_finite() => write!(text, "{separator}{v}"),
                _ => write!(text, "{separator}"),
            };
        }
        text.push('\n');
    }
    text
}

/// The value of a key in the header of a `.npy` file, which is a Python dictionary of three entries.
fn entry<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let from = header.find(&format!("'{key}':"))? + key.len() + 3;
    let rest = header[from..].trim_start();
    let end = match rest.as_bytes().first()? {
        b'(' => rest.find(')')? + 1,
        b'\'' => rest[1..].find('\'')? + 2,
        _ => rest.find([',', '}'])?,
    };
    Some(rest[..end].trim())
}

/// NumPy's format, versions 1 to 3: numbers in one or two dimensions.
fn npy(bytes: &[u8]) -> io::Result<String> {
    let cut = || wrong("is no .npy file, or cut off");
    let old = match bytes.get(..8) {
        Some(start) if start.starts_with(b"\x93NUMPY") => start[6] == 1,
        _ => return Err(cut()),
    };
    let size = bytes.get(8..if old { 10 } else { 12 }).ok_or_else(cut)?;
    let length = size.iter().rev().fold(0, |n, b| 256 * n + *b as usize);
    let from = 8 + size.len();
    let header = bytes.get(from..from + length).ok_or_else(cut)?;
    let header = std::str::from_utf8(header).map_err(|_| cut())?;
    let kind = entry(header, "descr").ok_or_else(cut)?.trim_matches('\'');
    let shape: Vec<usize> = entry(header, "shape")
        .ok_or_else(cut)?
        .trim_matches(['(', ')'])
        .split(',')
        .filter_map(|n| n.trim().parse().ok())
        .collect();
    let (rows, width) = match shape[..] {
        [rows] => (rows, 1),
        [rows, width] => (rows, width),
        _ => {
            return Err(wrong(
                "holds an array that is no table: one or two dimensions are read",
            ));
        }
    };
    let count = rows.checked_mul(width).ok_or_else(cut)?;
    let values = numbers(kind, bytes.get(from + length..).ok_or_else(cut)?)?;
    if values.len() < count {
        return Err(cut());
    }
    let by_columns = entry(header, "fortran_order") == Some("True");
    let at = |i: usize, j: usize| match by_columns {
        true => values[j * rows + i],
        false => values[i * width + j],
    };
    let columns: Vec<Vec<f64>> = (0..width)
        .map(|j| (0..rows).map(|i| at(i, j)).collect())
        .collect();
    Ok(text(None, &columns))
}

/// Numbers of a NumPy type, such as `<f8`.
fn numbers(kind: &str, bytes: &[u8]) -> io::Result<Vec<f64>> {
    let big = kind.starts_with('>');
    let name = kind.trim_start_matches(['<', '>', '|', '=']);
    macro_rules! read {
        ($of:ty) => {
            bytes
                .as_chunks::<{ size_of::<$of>() }>()
                .0
                .iter()
                .map(|b| match big {
                    true => <$of>::from_be_bytes(*b) as f64,
                    false => <$of>::from_le_bytes(*b) as f64,
                })
                .collect()
        };
    }
    Ok(match name {
        "f8" => read!(f64),
        "f4" => read!(f32),
        "i1" => read!(i8),
        "i2" => read!(i16),
        "i4" => read!(i32),
        "i8" => read!(i64),
        "u1" | "b1" => read!(u8),
        "u2" => read!(u16),
        "u4" => read!(u32),
        "u8" => read!(u64),
        _ => {
            return Err(wrong(format!(
                "holds values of type {kind}: real numbers are read"
            )));
        }
    })
}

/// MATLAB's format up to version 7. All real vectors and matrices of the commonest length are columns.
fn mat(bytes: &[u8]) -> io::Result<String> {
    if bytes.get(..8) == Some(b"\x89HDF\r\n\x1a\n") || bytes.get(..10) == Some(b"MATLAB 7.3") {
        return Err(wrong("is of version 7.3: save it with -v7"));
    }
    let file = matfile::MatFile::parse(bytes)
        .map_err(|_| wrong("is no .mat file of version 5 to 7, or cut off"))?;
    let mut found: Vec<(String, Vec<f64>)> = Vec::new();
    for array in file.arrays() {
        let [rows, width] = array.size()[..] else {
            continue;
        };
        let Some(values) = real(array.data()).filter(|v| v.len() == rows * width) else {
            continue;
        };
        if values.len() < 2 {
            continue;
        }
        if rows == 1 || width == 1 {
            found.push((array.name().to_owned(), values));
            continue;
        }
        for (j, column) in values.chunks(rows).enumerate() {
            found.push((format!("{}_{}", array.name(), j + 1), column.to_vec()));
        }
    }
    let alike = |length: usize| found.iter().filter(|(_, v)| v.len() == length).count();
    let Some(length) = found
        .iter()
        .map(|(_, v)| v.len())
        .max_by_key(|n| (alike(*n), *n))
    else {
        return Err(wrong(
            "holds no vector or matrix of real numbers, or is cut off",
        ));
    };
    found.retain(|(_, v)| v.len() == length);
    let (names, columns): (Vec<String>, Vec<Vec<f64>>) = found.into_iter().unzip();
    Ok(text(Some(&names), &columns))
}

/// The values of a real array, column by column.
fn real(data: &matfile::NumericData) -> Option<Vec<f64>> {
    use matfile::NumericData as Of;
    macro_rules! read {
        ($real:expr, $imag:expr) => {
            $imag
                .is_none()
                .then(|| $real.iter().map(|v| *v as f64).collect())
        };
    }
    match data {
        Of::Int8 { real, imag } => read!(real, imag),
        Of::UInt8 { real, imag } => read!(real, imag),
        Of::Int16 { real, imag } => read!(real, imag),
        Of::UInt16 { real, imag } => read!(real, imag),
        Of::Int32 { real, imag } => read!(real, imag),
        Of::UInt32 { real, imag } => read!(real, imag),
        Of::Int64 { real, imag } => read!(real, imag),
        Of::UInt64 { real, imag } => read!(real, imag),
        Of::Single { real, imag } => read!(real, imag),
        Of::Double { real, imag } => read!(real, imag),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn npy_of(header: &str, values: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(values);
        bytes
    }

    #[test]
    fn a_numpy_table_is_read_by_rows_or_by_columns() {
        let values: Vec<u8> = [1.0, 2.5, f64::NAN, 4.0, 5.0, 6.0]
            .iter()
            .flat_map(|v: &f64| v.to_le_bytes())
            .collect();
        let rows = "{'descr': '<f8', 'fortran_order': False, 'shape': (3, 2), }\n";
        assert_eq!(npy(&npy_of(rows, &values)).unwrap(), "1,2.5\n,4\n5,6\n");
        let columns = "{'descr': '<f8', 'fortran_order': True, 'shape': (3, 2), }\n";
        assert_eq!(npy(&npy_of(columns, &values)).unwrap(), "1,4\n2.5,5\n,6\n");
        let counts = "{'descr': '>i2', 'fortran_order': False, 'shape': (2,), }\n";
        assert_eq!(
            npy(&npy_of(counts, &[1, 0, 255, 254])).unwrap(),
            "256\n-2\n"
        );
    }

    #[test]
    fn what_is_no_numpy_table_gets_a_sentence() {
        let words = |bytes: &[u8]| npy(bytes).unwrap_err().to_string();
        assert!(words(b"time_s,pzt_um\n").contains("no .npy file"));
        let complex = "{'descr': '<c16', 'fortran_order': False, 'shape': (1,), }\n";
        assert!(words(&npy_of(complex, &[0; 16])).contains("real numbers"));
        let many = "{'descr': '<f8', 'fortran_order': False, 'shape': (9, 9), }\n";
        assert!(words(&npy_of(many, &[0; 16])).contains("cut off"));
        let vast =
            "{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 9999999999), }\n";
        assert!(words(&npy_of(vast, &[0; 16])).contains("cut off"));
        for cut in 0..20 {
            let _ = npy(&npy_of(many, &[0; 16])[..cut]);
        }
    }

    /// A MATLAB file of version 5 with vectors and matrices of doubles, not compressed.
    fn mat_of(arrays: &[(&str, [u32; 2], &[f64])]) -> Vec<u8> {
        let mut bytes = b"MATLAB 5.0 MAT-file".to_vec();
        bytes.resize(124, b' ');
        bytes.extend([0, 1, b'I', b'M']);
        let element = |kind: u32, data: &[u8]| -> Vec<u8> {
            let mut e = kind.to_le_bytes().to_vec();
            e.extend((data.len() as u32).to_le_bytes());
            e.extend(data);
            e.resize(e.len().next_multiple_of(8), 0);
            e
        };
        for (name, size, values) in arrays {
            let size: Vec<u8> = size.iter().flat_map(|n| n.to_le_bytes()).collect();
            let values: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            let mut body = element(6, &[6, 0, 0, 0, 0, 0, 0, 0]);
            body.extend(element(5, &size));
            body.extend(element(1, name.as_bytes()));
            body.extend(element(9, &values));
            bytes.extend(element(14, &body));
        }
        bytes
    }

    #[test]
    fn vectors_of_a_matlab_file_are_columns_of_their_names() {
        let bytes = mat_of(&[
            ("input", [1, 3], &[0.5, 1.0, -2.0]),
            ("fs", [1, 1], &[200.0]),
            ("both", [3, 2], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        ]);
        let read = mat(&bytes).unwrap();
        assert_eq!(read, "input,both_1,both_2\n0.5,1,4\n1,2,5\n-2,3,6\n");
        assert!(mat(b"time_s").unwrap_err().to_string().contains("no .mat"));
        let new = mat(b"MATLAB 7.3 MAT-file").unwrap_err();
        assert!(new.to_string().contains("-v7"));
    }
}
