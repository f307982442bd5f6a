//! The page of a run that is made up, for work on the page: `cargo run -p cellpos-live --example made_up_run`.
//!
//! Prints the operator's link and the viewer's, and ends after the seconds given (60).

use cellpos_live::{
    Banner, CycleRow, EventLine, Feed, Hello, OperatorRequest, Picture, Row, Server, ServerConfig,
    State,
};
use std::sync::mpsc;
use std::time::{Duration, Instant};

const SIZE: u16 = 128;

/// A bright spot at a place, px.
fn draw(picture: &mut Picture, x: f32) {
    let y = f32::from(SIZE) / 4.0;
    (picture.width, picture.height) = (SIZE, SIZE / 2);
    for row in 0..SIZE / 2 {
        for column in 0..SIZE {
            let r2 = (f32::from(column) - x).powi(2) + (f32::from(row) - y).powi(2);
            let value = 60.0 + 60.0 * (-r2 / 12.0).exp() + f32::from((row * 31 + column * 17) % 7);
            picture.pixels.push(value as u8);
        }
    }
    (picture.um_per_px, picture.first_um) = (0.2, -12.7);
    (picture.centre_px, picture.half_px, picture.gate_px) = ([x, y], [5.0, 5.0], 15.0);
}

fn main() {
    let seconds = std::env::args()
        .nth(1)
        .and_then(|s| s.parse().ok())
        .unwrap_or(60.0);
    let (mut feed, hub) = Feed::new(Hello {
        name: "2026-11-21T22-00-00Z-<b>hold</b>".into(),
        subtitle: "track, lqg, made up".into(),
        slew_um_per_s: 2000.0,
        view_um: [-12.8, 12.8],
        budget_us: 500.0,
        predicted_spectrum: (1..500).map(|f| [f64::from(f), 2.0, 0.0]).collect(),
        steered: true,
        script: true,
        pictures: true,
        ..Hello::default()
    });
    let mut pictures = feed.take_pictures().expect("asked for once");
    let (asked, asks) = mpsc::channel();
    let server = Server::start(&ServerConfig::default(), hub, move |command| {
        let _ = asked.send(command);
    })
    .expect("a free port on loopback");
    println!("{}\n{}", server.operator_url(), server.viewer_url());
    let start = Instant::now();
    let mut target_um = 0.0;
    let mut banner = Banner {
        state: "running",
        reason: "The loop is closed.".into(),
    };
    for tick in 0_u32.. {
        let time_s = f64::from(tick) * 1e-3;
        if time_s > seconds {
            break;
        }
        if let Some(ahead) = Duration::from_secs_f64(time_s).checked_sub(start.elapsed()) {
            std::thread::sleep(ahead);
        }
        while let Ok(command) = asks.try_recv() {
            match command {
                OperatorRequest::Target { um } => target_um = um,
                OperatorRequest::Freeze | OperatorRequest::Pause => banner.state = "frozen",
                OperatorRequest::Park => banner.state = "safe",
                _ => banner.state = "running",
            }
            feed.event(EventLine {
                time_s,
                level: "warning",
                text: format!("The page asked: {command:?}"),
            });
        }
        let wave = (time_s * 40.0).sin() + (time_s * 171.0).sin() + (time_s * 733.0).sin();
        let measured_um = (target_um + 0.04 * wave) as f32;
        feed.row(&Row {
            seq: tick,
            time_s,
            measured_um: if tick % 997 == 0 {
                f32::NAN
            } else {
                measured_um
            },
            target_um: target_um as f32,
            target_then_um: target_um as f32,
            command_um: (20.0 - 0.3 * wave) as f32,
            zero_flow_um: 20.0,
            wake_us: 20.0 + (tick % 50) as f32,
            compute_us: 5.0 + (tick % 9) as f32,
            ..Row::default()
        });
        if pictures.is_due(time_s) {
            pictures.offer(time_s, |picture| draw(picture, (measured_um + 12.7) / 0.2));
        }
        if tick % 250 == 0 {
            feed.state(State {
                banner: banner.clone(),
                time_s,
                ticks: u64::from(tick),
                rms_nm: Some(49.0),
                bound_nm: Some(44.5),
                late: u64::from(tick / 5000),
                cycle: Some([u64::from(tick / 1000) + 1, 180]),
                next: Some("hold 5 s at 0 um".into()),
                left_s: Some(seconds - time_s),
                ..State::default()
            });
        }
        if tick % 1000 == 999 {
            let cycle = u64::from(tick / 1000) + 1;
            feed.cycle(CycleRow {
                cycle,
                amplitude_um: Some(5.0 + 0.01 * wave),
                stretch: Some(3.8 - 0.01 * cycle as f64),
                recovery_s: None,
            });
            feed.event(EventLine {
                time_s,
                level: "info",
                text: format!("Cycle {cycle} is over. <i>Text stays text.</i>"),
            });
        }
    }
}
