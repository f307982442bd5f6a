//! Pictures of pixels within a page.

use crate::svg::set;
use std::fmt::Write;

/// A picture that a page carries within itself.
#[derive(Debug, Clone)]
pub(crate) struct Picture {
    /// Name of its file, when it is taken along.
    pub(crate) name: String,
    /// Description for readers who cannot see it.
    pub(crate) shows: String,
    pub(crate) caption: String,
    /// A PNG file.
    pub(crate) png: Vec<u8>,
}

/// Bytes as text (RFC 4648).
pub(crate) fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let at = |n: usize| u32::from(chunk.get(n).copied().unwrap_or(0));
        let bits = at(0) << 16 | at(1) << 8 | at(2);
        for n in 0..4 {
            if n <= chunk.len() {
                let digit = bits >> (18 - 6 * n) & 63;
                out.push(char::from(DIGITS[digit as usize]));
            } else {
                out.push('=');
            }
        }
    }
    out
}

impl Picture {
    pub(crate) fn html(&self, out: &mut String, number: usize) {
        let (shows, caption, name) = (set(&self.shows), set(&self.caption), &self.name);
        let data = format!("data:image/png;base64,{}", base64(&self.png));
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "<figure>\n<img class=\"pixels\" alt=\"{shows}\" src=\"{data}\">\n<figcaption>Figure {number}. {caption} \
             <span class=\"take\"><a download=\"{name}.png\" href=\"{data}\">PNG</a></span></figcaption>\n</figure>"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::base64;

    #[test]
    fn the_examples_of_the_standard_come_out() {
        for (bytes, text) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
    }
}
