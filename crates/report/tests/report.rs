//! Behaviour of whole reports.

use cellpos_report::{Axis, Column, Emphasis, Figure, HeatMap, Panel, Report, Series, Table};
use proptest::prelude::*;

/// A strict little XML check: tags nest, attributes are quoted, no bare ampersand or angle bracket.
fn well_formed(text: &str) -> Result<(), String> {
    let mut open: Vec<String> = Vec::new();
    let mut rest = text;
    while let Some(start) = rest.find('<') {
        let between = &rest[..start];
        for (at, _) in between.match_indices('&') {
            let entity = between[at..].split(';').next().unwrap_or("");
            if !["&amp", "&lt", "&gt", "&quot", "&#39"].contains(&entity) {
                return Err(format!("bare ampersand: {entity}"));
            }
        }
        if between.contains('>') {
            return Err(format!("bare bracket in {between:?}"));
        }
        let end = rest[start..].find('>').ok_or("unclosed tag")? + start;
        let tag = &rest[start + 1..end];
        if !tag.matches('"').count().is_multiple_of(2) {
            return Err(format!("unbalanced quotes in {tag:?}"));
        }
        if let Some(name) = tag.strip_prefix('/') {
            let expected = open.pop().ok_or("closing tag without opening")?;
            if expected != name {
                return Err(format!("</{name}> closes <{expected}>"));
            }
        } else if !tag.ends_with('/') && !tag.starts_with('!') {
            let name = tag.split_whitespace().next().unwrap_or("").to_owned();
            if name != "meta" {
                open.push(name);
            }
        }
        rest = &rest[end + 1..];
    }
    if open.is_empty() {
        Ok(())
    } else {
        Err(format!("left open: {open:?}"))
    }
}

fn sample(text: &str, data: &[f64]) -> Report {
    let index: Vec<f64> = (0..data.len()).map(|k| k as f64).collect();
    let mut report = Report::new(text);
    report
        .section(text)
        .subsection(text)
        .paragraph(text)
        .note(Emphasis::Bad, text)
        .list(&[text])
        .verbatim(text);
    let mut table = Table::new([Column::left(text), Column::right(text)]);
    table
        .row([text, text, text])
        .row_with(Emphasis::Good, [text])
        .caption(text);
    report.table(table);
    for axis in [Axis::linear(text, text), Axis::log(text, text)] {
        let plane = Panel::new(axis.clone(), axis.clone())
            .equal_axes()
            .series(Series::line(text, data, data));
        report.figure(
            Figure::new(text, text)
                .panel(
                    Panel::new(axis.clone(), axis)
                        .title(text)
                        .series(Series::line(text, data, data))
                        .series(Series::step(text, &index, data).dashed())
                        .series(Series::points(text, data, &index))
                        .series(Series::intervals(text, data, data, &index, data))
                        .series(Series::band(text, &index, data, &index).color(9))
                        .series(Series::histogram(text, data, 7))
                        .vertical(data.first().copied().unwrap_or(0.0), text)
                        .horizontal(data.last().copied().unwrap_or(0.0), text),
                )
                .panel(
                    Panel::new(Axis::categories(text, &[text, text]), Axis::linear("", ""))
                        .equal_axes(),
                )
                .panel(plane),
        );
    }
    report.figure(Figure::heat_map(
        text,
        text,
        HeatMap::new(text, &[text, "b"], &["c", text], data),
    ));
    report
}

#[test]
fn the_same_calls_give_the_same_bytes() {
    let data = [1.0, 2.0, -3.0, f64::NAN, 5e8];
    assert_eq!(sample("a", &data).to_html(), sample("a", &data).to_html());
}

#[test]
fn a_report_loads_nothing_and_runs_nothing() {
    let html = sample("<script src=\"http://example.org/x.js\">", &[1.0, 2.0]).to_html();
    assert!(!html.contains("<script"));
    assert!(!html.contains(" src=\""), "no element may load anything");
    assert!(!html.contains("@import") && !html.contains("url("));
    let links: Vec<_> = html.match_indices("http://").collect();
    assert!(
        links.iter().all(
            |(at, _)| html[*at..].starts_with("http://www.w3.org/2000/svg")
                || html[..*at].ends_with("&quot;")
        ),
        "only the SVG name space may be named"
    );
}

#[test]
fn a_quarter_of_an_hour_at_one_kilohertz_stays_a_small_picture() {
    let t: Vec<f64> = (0..900_000).map(|k| f64::from(k) / 1000.0).collect();
    let y: Vec<f64> = t
        .iter()
        .map(|t| (t * 31.0).sin() + (t * 7777.0).cos())
        .collect();
    let figure = Figure::new("long", "").panel(
        Panel::new(Axis::linear("time", "s"), Axis::linear("bead", "um"))
            .series(Series::line("bead", &t, &y))
            .series(Series::step("held", &t, &y))
            .series(Series::points("dots", &t, &y)),
    );
    let svg = figure.to_svg();
    assert!(svg.len() < 1_500_000, "{} bytes", svg.len());
    let line_only = Figure::new("long", "").panel(
        Panel::new(Axis::linear("time", "s"), Axis::linear("bead", "um"))
            .series(Series::line("bead", &t, &y)),
    );
    assert!(
        line_only.to_svg().len() < 60_000,
        "{}",
        line_only.to_svg().len()
    );
}

#[test]
fn figures_are_written_beside_the_page_and_names_never_collide() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("deep/er/gap.html");
    sample("same name", &[1.0, 2.0])
        .write_with_figures(&path)
        .unwrap();
    let mut names: Vec<String> = std::fs::read_dir(folder.path().join("deep/er/gap-figures"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(
        names,
        [
            "captions.txt",
            "same-name-2.csv",
            "same-name-2.pdf",
            "same-name-2.svg",
            "same-name-3.csv",
            "same-name-3.pdf",
            "same-name-3.svg",
            "same-name.csv",
            "same-name.pdf",
            "same-name.svg",
        ]
    );
    let beside =
        |name: &str| std::fs::read(folder.path().join("deep/er/gap-figures").join(name)).unwrap();
    assert!(beside("same-name.pdf").starts_with(b"%PDF-1.4"));
    let captions = String::from_utf8(beside("captions.txt")).unwrap();
    for number in 1..=3 {
        assert!(
            captions.contains(&format!("Figure {number} (same-name")),
            "{captions}"
        );
    }
    assert!(path.exists());
    assert!(!folder.path().join("deep/er/gap.html.part").exists());
}

#[test]
fn a_file_that_cannot_be_written_is_named_in_the_error() {
    let folder = tempfile::tempdir().unwrap();
    let blocked = folder.path().join("file");
    std::fs::write(&blocked, "x").unwrap();
    let error = Report::new("x")
        .write(&blocked.join("report.html"))
        .unwrap_err();
    assert!(error.to_string().contains("report.html"), "{error}");
}

#[test]
fn a_point_stands_where_the_axes_say() {
    // Frame: left 82, width 820 - 82 - 16 = 722; fixed ranges make the place exact.
    let svg = Figure::new("p", "")
        .panel(
            Panel::new(
                Axis::log("f", "Hz").range(1.0, 100.0),
                Axis::linear("g", "dB").range(-10.0, 10.0),
            )
            .height_px(200.0)
            .series(Series::points("", &[10.0], &[5.0])),
        )
        .to_svg();
    assert!(svg.contains("cx=\"361\" cy=\"50\""), "{svg}");
}

proptest! {
    // A debug build draws fewer: the nightly run, a release build, draws all, and others each night.
    #![proptest_config(ProptestConfig::with_cases(if cfg!(debug_assertions) { 16 } else { 64 }))]

    #[test]
    fn any_text_and_any_numbers_give_a_well_formed_page(
        text in any::<String>(),
        data in proptest::collection::vec(proptest::num::f64::ANY, 0..40),
    ) {
        let report = sample(&text, &data);
        // The style sheet holds no markup; the page is checked from the body on.
        let html = report.to_html();
        let body = html.split_once("</head>").map(|(_, body)| body.replace("</html>", "")).unwrap();
        prop_assert_eq!(well_formed(&body), Ok(()));
        for figure in report.figures() {
            prop_assert_eq!(well_formed(&figure.to_svg()), Ok(()));
            prop_assert!(!figure.to_svg().contains("NaN") || text.contains("NaN"));
            let _ = figure.to_csv();
        }
    }
}
