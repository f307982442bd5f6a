//! Draws a run on the whole terminal, from 40 columns and 12 rows.

use super::history::{History, SPAN_S};
use cellpos_live::{EventLine, Hello};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Style, Stylize};
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Axis, Chart, Dataset, GraphType, Paragraph, Row, Table};

/// Rows from which the PZT has a separate trace.
const ROWS_FOR_PZT: u16 = 24;
/// Columns from which the cycles are to the right of the events.
const COLUMNS_FOR_CYCLES: u16 = 72;

/// Draws it all.
pub(super) fn screen(
    frame: &mut Frame<'_>,
    hello: &Hello,
    history: &History,
    keys: &str,
    typed: &str,
) {
    let area = frame.area();
    let script = steps(history);
    let events = (area.height / 4).clamp(2, 12);
    let [banner, figures, gauge, doing, traces, log, last] = Layout::vertical([
        Constraint::Length(1),
        Constraint::Length(1),
        Constraint::Length(1),
        Constraint::Length(u16::from(!script.is_empty())),
        Constraint::Min(3),
        Constraint::Length(events),
        Constraint::Length(1),
    ])
    .areas(area);
    frame.render_widget(banner_line(history), banner);
    frame.render_widget(fit(figure_parts(history), figures.width), figures);
    frame.render_widget(gauge_line(hello, history, gauge.width), gauge);
    frame.render_widget(fit(script, doing.width), doing);
    if area.height >= ROWS_FOR_PZT {
        let [above, below] =
            Layout::vertical([Constraint::Fill(3), Constraint::Fill(2)]).areas(traces);
        trace(frame, above, history, &POSITION);
        trace(frame, below, history, &PZT);
    } else {
        trace(frame, traces, history, &POSITION);
    }
    if !history.cycles.is_empty() && area.width >= COLUMNS_FOR_CYCLES {
        let [left, right] = Layout::horizontal([Constraint::Min(20), Constraint::Length(36)])
            .spacing(2)
            .areas(log);
        event_lines(frame, left, history);
        cycle_table(frame, right, history);
    } else {
        event_lines(frame, log, history);
    }
    frame.render_widget(last_line(history, keys, typed), last);
}

fn banner_line(history: &History) -> Paragraph<'_> {
    let banner = &history.state.banner;
    let back = match banner.state {
        "running" => Color::Green,
        "armed" => Color::Blue,
        "frozen" | "paused" => Color::Yellow,
        "safe" | "failed" => Color::Red,
        _ => Color::Gray,
    };
    let state = Span::raw(format!(" {} ", banner.state.to_uppercase()))
        .fg(Color::Black)
        .bg(back)
        .bold();
    Paragraph::new(Line::from(vec![
        state,
        Span::raw(format!(" {}", banner.reason)),
    ]))
}

/// The parts next to each other, as far as there is room.
fn fit(parts: Vec<(String, Style)>, columns: u16) -> Paragraph<'static> {
    let mut spans = vec![];
    let mut room = usize::from(columns);
    for (text, style) in parts {
        let length = text.chars().count() + 2;
        if length > room + 2 {
            continue;
        }
        room = room.saturating_sub(length);
        spans.push(Span::styled(text, style));
        spans.push(Span::raw("  "));
    }
    Paragraph::new(Line::from(spans))
}

fn figure_parts(history: &History) -> Vec<(String, Style)> {
    let state = &history.state;
    let (plain, quiet) = (Style::new(), Style::new().fg(Color::Gray));
    let alarm = |count: u64| {
        if count > 0 {
            Style::new().fg(Color::Red).bold()
        } else {
            quiet
        }
    };
    let mut parts = vec![(clock(state.time_s), plain)];
    if let Some(row) = &history.last
        && row.measured_um.is_finite()
        && row.target_then_um.is_finite()
    {
        let error_nm = 1e3 * (row.measured_um - row.target_then_um);
        parts.push((format!("error {error_nm:+5.0} nm"), plain));
    }
    if let Some(rms_nm) = state.rms_nm {
        parts.push((format!("RMS {rms_nm:.1} nm"), plain.bold()));
    }
    if let Some(bound_nm) = state.bound_nm {
        parts.push((format!("lowest {bound_nm:.1} nm"), quiet));
    }
    parts.push((format!("late {}", state.late), alarm(state.late)));
    parts.push((format!("skipped {}", state.skipped), alarm(state.skipped)));
    parts.push((format!("frames lost {}", state.frames_lost), quiet));
    parts.push((format!("stale {}", state.stale), alarm(state.stale)));
    parts.push((format!("coasted {}", state.coasted), quiet));
    if state.records_lost > 0 {
        let text = format!("records lost {}", state.records_lost);
        parts.push((text, alarm(1)));
    }
    if let Some(wake_us) = state.wake_us {
        parts.push((format!("wake-up 99.9 % {wake_us:.0} µs"), quiet));
    }
    parts
}

fn clock(seconds: f64) -> String {
    let whole = seconds.max(0.0) as u64;
    format!("{}:{:02}:{:02}", whole / 3600, whole / 60 % 60, whole % 60)
}

/// The present step, the next one, and their durations.
fn steps(history: &History) -> Vec<(String, Style)> {
    let state = &history.state;
    let (plain, quiet) = (Style::new(), Style::new().fg(Color::Gray));
    let mut parts = vec![];
    if let Some([cycle, of]) = state.cycle {
        parts.push((format!("cycle {cycle} of {of}"), plain.bold()));
    }
    if let Some(doing) = &state.doing {
        parts.push((doing.clone(), plain));
    }
    if let Some(left_s) = state.left_s {
        parts.push((format!("{} left", clock(left_s)), plain));
    }
    if let Some(next) = &state.next {
        parts.push((format!("next: {next}"), quiet));
    }
    parts
}

/// The PZT within its range, and the displacement of zero flow.
fn gauge_line(hello: &Hello, history: &History, columns: u16) -> Paragraph<'static> {
    let [low, high] = hello.range_um;
    let (command, rest) = history.last.map_or((f64::NAN, f64::NAN), |row| {
        (f64::from(row.command_um), f64::from(row.zero_flow_um))
    });
    let text = if command.is_finite() {
        format!(" {command:6.2} µm")
    } else {
        "      - µm".to_string()
    };
    let (first, last) = (format!("PZT {low:.0} "), format!(" {high:.0}"));
    let used = first.chars().count() + last.chars().count() + text.chars().count();
    let width = usize::from(columns).saturating_sub(used);
    let place = |um: f64| {
        let part = (um - low) / (high - low);
        part.is_finite()
            .then(|| ((part.clamp(0.0, 1.0) * width as f64) as usize).min(width.saturating_sub(1)))
    };
    let (to, mark) = (place(command), place(rest));
    // A tenth of the range must remain for control.
    let near = command - low < 0.1 * (high - low) || high - command < 0.1 * (high - low);
    let colour = if near { Color::Red } else { Color::Green };
    let bar = (0..width).map(|n| {
        if Some(n) == mark {
            Span::raw("|").fg(Color::Magenta).bold()
        } else if to.is_some_and(|to| n <= to) {
            Span::raw("█").fg(colour)
        } else {
            Span::raw("░").fg(Color::Gray)
        }
    });
    let mut spans = vec![Span::raw(first)];
    spans.extend(bar);
    spans.push(Span::raw(last).fg(Color::Gray));
    spans.push(Span::raw(text).fg(colour));
    Paragraph::new(Line::from(spans))
}

/// The values that a panel of traces shows.
struct Panel {
    unit: &'static str,
    lines: &'static [Trace],
}

/// A line of a panel: its name, its colour, and least and greatest value of a bin.
type Trace = (&'static str, Color, fn(&super::history::Bin) -> [f64; 2]);

const POSITION: Panel = Panel {
    unit: "µm",
    lines: &[
        ("target", Color::Yellow, |bin| bin.target_um),
        ("position", Color::Cyan, |bin| bin.position_um),
    ],
};
const PZT: Panel = Panel {
    unit: "µm",
    lines: &[("PZT", Color::Green, |bin| bin.command_um)],
};

fn trace(frame: &mut Frame<'_>, area: Rect, history: &History, panel: &Panel) {
    let now_s = history.bins.back().map_or(0.0, |bin| bin.time_s);
    let mut ends = [f64::INFINITY, f64::NEG_INFINITY];
    let points: Vec<Vec<(f64, f64)>> = (panel.lines.iter())
        .map(|(_, _, range)| {
            let mut points = vec![];
            for bin in &history.bins {
                let [low, high] = range(bin);
                if low <= high {
                    ends = [ends[0].min(low), ends[1].max(high)];
                    points.extend([(bin.time_s - now_s, low), (bin.time_s - now_s, high)]);
                }
            }
            points
        })
        .collect();
    if ends[0] > ends[1] {
        let line = Paragraph::new("nothing is seen yet").fg(Color::Gray);
        frame.render_widget(line, area);
        return;
    }
    let margin = (0.05 * (ends[1] - ends[0])).max(0.01);
    let [low, high] = [ends[0] - margin, ends[1] + margin];
    let sets = (panel.lines.iter().zip(&points)).map(|((name, colour, _), points)| {
        Dataset::default()
            .name(*name)
            .marker(Marker::Braille)
            .graph_type(GraphType::Line)
            .style(Style::new().fg(*colour))
            .data(points)
    });
    let quiet = Style::new().fg(Color::Gray);
    let label = |value: f64| Span::raw(format!("{value:>7.2}"));
    let mut title: Vec<Span<'_>> = (panel.lines.iter())
        .map(|(name, colour, _)| Span::raw(format!("{name} ")).fg(*colour))
        .collect();
    title.push(Span::raw(panel.unit));
    let chart = Chart::new(sets.collect())
        .x_axis(
            Axis::default()
                .bounds([-SPAN_S, 0.0])
                .labels([format!("-{SPAN_S:.0} s"), "now".to_string()])
                .style(quiet),
        )
        .y_axis(
            Axis::default()
                .title(Line::from(title))
                .bounds([low, high])
                .labels([label(low), label(high)])
                .style(quiet),
        );
    frame.render_widget(chart, area);
}

fn event_lines(frame: &mut Frame<'_>, area: Rect, history: &History) {
    let line = |event: &EventLine| {
        let style = match event.level {
            "fault" => Style::new().fg(Color::Red).bold(),
            "warning" => Style::new().fg(Color::Yellow),
            _ => Style::new(),
        };
        Line::from(vec![
            Span::raw(format!("{:>9.3} s ", event.time_s)).fg(Color::Gray),
            Span::styled(event.text.clone(), style),
        ])
    };
    let lines: Vec<Line<'_>> = (history.events.iter())
        .take(area.height.into())
        .map(line)
        .collect();
    frame.render_widget(Paragraph::new(lines), area);
}

fn cycle_table(frame: &mut Frame<'_>, area: Rect, history: &History) {
    let number = |value: Option<f64>, digits: usize| {
        value.map_or_else(|| "-".to_string(), |value| format!("{value:.digits$}"))
    };
    let rows = (history.cycles.iter())
        .take(area.height.saturating_sub(1).into())
        .map(|cycle| {
            Row::new([
                cycle.cycle.to_string(),
                number(cycle.amplitude_um, 3),
                number(cycle.stretch, 3),
                number(cycle.recovery_s, 3),
            ])
        });
    let head = Row::new(["cycle", "ampl. µm", "stretch", "recov. s"]).fg(Color::Gray);
    let widths = [Constraint::Length(8); 4];
    frame.render_widget(Table::new(rows, widths).header(head), area);
}

fn last_line(history: &History, keys: &str, typed: &str) -> Paragraph<'static> {
    let quiet = Style::new().fg(Color::Gray);
    if !typed.is_empty() {
        return Paragraph::new(format!("target: {typed}_")).bold();
    }
    if !history.said.is_empty() {
        return Paragraph::new(history.said.clone()).fg(Color::Yellow);
    }
    Paragraph::new(keys.to_string()).style(quiet)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_live::{Banner, CycleRow, Row as Tick, State};
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    fn history() -> History {
        let mut history = History {
            state: State {
                banner: Banner {
                    state: "running",
                    reason: "The loop is closed.".to_string(),
                },
                time_s: 3723.4,
                rms_nm: Some(57.3),
                late: 3,
                cycle: Some([12, 40]),
                next: Some("hold 1.00 um for 2.000 s".to_string()),
                left_s: Some(61.0),
                ..State::default()
            },
            ..History::default()
        };
        for k in 0..10_000_u32 {
            let time_s = f64::from(k) * 1e-3;
            history.row(&Tick {
                time_s,
                measured_um: (3.0 * time_s).sin() as f32,
                target_um: 0.0,
                target_then_um: 0.0,
                command_um: 20.0,
                zero_flow_um: 30.0,
                ..Tick::default()
            });
        }
        history.event(
            EventLine {
                time_s: 1.5,
                level: "warning",
                text: "A frame was lost.".to_string(),
            },
            false,
        );
        history.cycle(CycleRow {
            cycle: 11,
            amplitude_um: Some(1.987),
            stretch: None,
            recovery_s: Some(0.25),
        });
        history
    }

    fn drawn(columns: u16, rows: u16, typed: &str) -> String {
        let mut terminal = Terminal::new(TestBackend::new(columns, rows)).unwrap();
        let (hello, history) = (Hello::default(), history());
        terminal
            .draw(|frame| screen(frame, &hello, &history, "f freeze, q stop", typed))
            .unwrap();
        terminal.backend().to_string()
    }

    #[test]
    fn a_wide_terminal_shows_everything() {
        let text = drawn(110, 32, "");
        for part in [
            "RUNNING",
            "The loop is closed.",
            "1:02:03",
            "RMS 57.3 nm",
            "late 3",
            "20.00 µm",
            "cycle 12 of 40",
            "next: hold",
            "0:01:01 left",
            "A frame was lost.",
            "1.987",
            "f freeze, q stop",
            "-10 s",
            "target position µm",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        // The picture shows the sine's excursions.
        let dots = text
            .chars()
            .filter(|c| ('\u{2801}'..='\u{28ff}').contains(c));
        assert!(dots.count() > 100, "{text}");
    }

    #[test]
    fn forty_columns_and_twelve_rows_hold_what_matters() {
        let text = drawn(40, 12, "-2.5");
        for part in ["RUNNING", "1:02:03", "PZT", "A frame was", "target: -2.5_"] {
            assert!(text.contains(part), "{part}\n{text}");
        }
    }

    #[test]
    fn no_size_of_a_terminal_is_too_small_to_be_drawn() {
        for (columns, rows) in [(1, 1), (2, 3), (10, 5), (39, 11), (300, 2), (3, 100)] {
            let _ = drawn(columns, rows, "");
        }
    }

    #[test]
    fn the_gauge_shows_where_the_pzt_stands_and_warns_near_an_end() {
        let mut terminal = Terminal::new(TestBackend::new(60, 1)).unwrap();
        let mut history = history();
        for (command_um, warns) in [(20.0, false), (39.0, true), (0.5, true)] {
            history.row(&Tick {
                time_s: 11.0,
                command_um,
                zero_flow_um: 30.0,
                ..Tick::default()
            });
            terminal
                .draw(|frame| {
                    let line = gauge_line(&Hello::default(), &history, 60);
                    frame.render_widget(line, frame.area());
                })
                .unwrap();
            let buffer = terminal.backend().buffer();
            let red = buffer.content().iter().any(|cell| cell.fg == Color::Red);
            assert_eq!(red, warns, "{command_um}");
            let text: String = buffer.content().iter().map(|cell| cell.symbol()).collect();
            let filled = text.chars().filter(|c| *c == '█').count() as f32;
            let width = text.chars().filter(|c| "█░|".contains(*c)).count() as f32;
            assert!(
                (filled / width - command_um / 40.0).abs() < 0.06,
                "{command_um}: {text}"
            );
        }
    }
}
