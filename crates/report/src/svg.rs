//! Common parts of SVG elements: numbers, text, styles.

use crate::typeset::typeset;
/// Style shared by all figures. Plain rules instead of CSS variables: several SVG viewers know no variables.
pub(crate) const STYLE: &str = "\
.fg{font-family:system-ui,'DejaVu Sans','Segoe UI',Helvetica,Arial,sans-serif;font-size:12px}\
.fg text{fill:#2b2f36}.fg .mut{fill:#5c6470}.fg .ttl{font-weight:600}\
.fg .bg{fill:#fff}.fg .frm{fill:none;stroke:#9aa3ae;stroke-width:1}\
.fg .grd{stroke:#e3e7ec;stroke-width:1;fill:none}.fg .grm{stroke:#f1f3f6;stroke-width:1;fill:none}\
.fg .mrk{stroke:#5c6470;stroke-width:1;stroke-dasharray:2 3;fill:none}\
.fg .ln{fill:none;stroke-width:1.6;stroke-linejoin:round;stroke-linecap:round}.fg .thn{stroke-width:.8}.fg .spk{stroke-width:2.4}\
.fg .dsh{stroke-dasharray:6 4}.fg .bnd{stroke:none;fill-opacity:.2}.fg .bar{stroke:none;fill-opacity:.75}\
.fg .dot{stroke:none}.fg .scl{fill:#2b2f36}\
.fg .s0{stroke:#0072b2}.fg .s1{stroke:#d55e00}.fg .s2{stroke:#009e73}.fg .s3{stroke:#b2589a}\
.fg .s4{stroke:#b98200}.fg .s5{stroke:#3f9bd1}.fg .s6{stroke:#6b5fc7}.fg .s7{stroke:#444b55}\
.fg .f0{fill:#0072b2}.fg .f1{fill:#d55e00}.fg .f2{fill:#009e73}.fg .f3{fill:#b2589a}\
.fg .f4{fill:#b98200}.fg .f5{fill:#3f9bd1}.fg .f6{fill:#6b5fc7}.fg .f7{fill:#444b55}\
@media (prefers-color-scheme:dark){\
.fg text,.fg .scl{fill:#e4e7eb}.fg .mut{fill:#a3acb8}.fg .bg{fill:#14171b}.fg .frm{stroke:#6a7380}\
.fg .grd{stroke:#2a2f37}.fg .grm{stroke:#1f242a}.fg .mrk{stroke:#a3acb8}\
.fg .s0{stroke:#4fb0ea}.fg .s1{stroke:#ff8a3d}.fg .s2{stroke:#2ecc9b}.fg .s3{stroke:#e093c6}\
.fg .s4{stroke:#f0b429}.fg .s5{stroke:#8fd0f5}.fg .s6{stroke:#a89df5}.fg .s7{stroke:#c9ced6}\
.fg .f0{fill:#4fb0ea}.fg .f1{fill:#ff8a3d}.fg .f2{fill:#2ecc9b}.fg .f3{fill:#e093c6}\
.fg .f4{fill:#f0b429}.fg .f5{fill:#8fd0f5}.fg .f6{fill:#a89df5}.fg .f7{fill:#c9ced6}\
.fg text.cell{fill:#1b1e23}.fg text.cellw{fill:#fff}}\
.fg text.cell{fill:#1b1e23}.fg text.cellw{fill:#fff}.fg .nil{fill:#8a929c;fill-opacity:.25}";

/// Width of every figure, px.
pub(crate) const WIDTH_PX: f64 = 820.0;
/// Width of a figure for a narrow screen, px: on a screen of 400 px its 12 px letters are shown with 10 px.
pub(crate) const SLIM_PX: f64 = 400.0;
/// The palette on paper: Okabe and Ito's, partly darkened for white paper. The style sheet has the same colours.
pub(crate) const PALETTE: [u32; 8] = [
    0x0072b2, 0xd55e00, 0x009e73, 0xb2589a, 0xb98200, 0x3f9bd1, 0x6b5fc7, 0x444b55,
];

/// Text made safe for HTML and XML: markup escaped, characters that XML forbids replaced.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            '\t' | '\n' => out.push(c),
            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// [`escape`] of a text with its units as people write them.
pub(crate) fn set(text: &str) -> String {
    escape(&typeset(text))
}

/// As [`set`], a number and its unit on one line.
pub(crate) fn set_together(text: &str) -> String {
    const UNITS: [&str; 10] = [
        "%", "nm", "\u{b5}m", "ms", "s", "min", "h", "Hz", "dB", "/s",
    ];
    let mut out = String::with_capacity(text.len());
    for word in set(text).split_inclusive(' ') {
        let name = word.trim_end_matches([' ', '.', ',', ';', ':', ')']);
        if UNITS.contains(&name) && out.ends_with(' ') {
            out.pop();
            let after_number = out.ends_with(|c: char| c.is_ascii_digit());
            out.push(if after_number { '\u{a0}' } else { ' ' });
        }
        out.push_str(word);
    }
    out
}

/// A coordinate to a tenth of a pixel, in its shortest form.
pub(crate) fn px(value: f64) -> String {
    let tenths = if value.is_finite() {
        (value * 10.0).round().clamp(-1e9, 1e9) as i64
    } else {
        0
    };
    let sign = if tenths < 0 { "-" } else { "" };
    let tenths = tenths.abs();
    if tenths % 10 == 0 {
        format!("{sign}{}", tenths / 10)
    } else {
        format!("{sign}{}.{}", tenths / 10, tenths % 10)
    }
}

/// Width of a text in the figures' font, px; an estimate that errs on the wide side.
pub(crate) fn text_width_px(text: &str) -> f64 {
    text.chars()
        .map(|c| match c {
            'i' | 'j' | 'l' | 't' | 'f' | 'r' | '.' | ',' | ':' | ';' | '|' | '\'' | '(' | ')'
            | ' ' => 4.4,
            'm' | 'w' | 'M' | 'W' => 10.5,
            c if c.is_ascii_uppercase() => 8.4,
            _ => 7.3,
        })
        .sum()
}

/// Distance of the lines of one text, px.
pub(crate) const LINE_PX: f64 = 15.0;

/// The parts of a text between which a line may end: each with the spaces, or the hyphen, that end it.
fn parts(text: &str) -> impl Iterator<Item = &str> {
    text.split_inclusive([' ', '-', '\u{2013}', '/', '_'])
}

/// Width of the widest part of a text that stays in one line, px.
pub(crate) fn part_width_px(text: &str) -> f64 {
    let widths = parts(text).map(|part| text_width_px(part.trim_end()));
    widths.fold(0.0, f64::max)
}

/// A text in lines of at most a width; nothing of it is left out. A part wider than that is broken anywhere.
pub(crate) fn lines(text: &str, width_px: f64) -> Vec<String> {
    let fits = |line: &str| text_width_px(line.trim_end()) <= width_px;
    let mut lines = vec![String::new()];
    let mut put = |piece: &str| match lines.last_mut() {
        Some(line) if line.is_empty() || fits(&format!("{line}{piece}")) => line.push_str(piece),
        _ => lines.push(piece.to_owned()),
    };
    for part in parts(text) {
        if fits(part) {
            put(part);
        } else {
            part.split_inclusive(|_| true).for_each(&mut put);
        }
    }
    lines
        .iter()
        .map(|line| line.trim_end().to_owned())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_are_short_and_never_negative_zero() {
        assert_eq!(px(1.0), "1");
        assert_eq!(px(-0.01), "0");
        assert_eq!(px(-1.25), "-1.3");
        assert_eq!(px(f64::NAN), "0");
    }

    #[test]
    fn markup_and_control_characters_cannot_get_out() {
        assert_eq!(
            escape("<b a=\"1\">&'"),
            "&lt;b a=&quot;1&quot;&gt;&amp;&#39;"
        );
        assert_eq!(escape("a\0b\u{1b}"), "a\u{fffd}b\u{fffd}");
    }

    #[test]
    fn a_long_text_takes_more_lines_and_loses_nothing() {
        for text in [
            "a rather long label that cannot fit",
            "80\u{2013}160",
            "20261122T143420Z-a-run",
            "short",
            "",
        ] {
            for width in [5.0, 30.0, 60.0, 400.0] {
                let set = lines(text, width);
                let all = set.concat().replace(' ', "");
                assert_eq!(all, text.replace(' ', ""), "{width} px: {set:?}");
                let widest = set.iter().map(|l| text_width_px(l)).fold(0.0, f64::max);
                assert!(widest <= width.max(10.5), "{width} px: {set:?}");
            }
        }
        assert_eq!(lines("80\u{2013}160", 40.0), ["80\u{2013}", "160"]);
    }
}
