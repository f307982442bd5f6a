//! A bead on the glass, stronger than the one that swims: the run takes the one that moves with the PZT.

use crate::common::{hold, run_on};
use cellpos_emulator::EmulatedRig;
use cellpos_rig::{Camera, CameraError, Clock, FrameBuffer, FrameStamp, SourceInfo};
use cellpos_runtime::life::{EventKind, Refusal};
use cellpos_runtime::{Event, RunSink, Statistics, TickRecord};
use cellpos_session::rig_file::Frames;
use cellpos_session::{EndKind, RigFile};
use cellpos_vision::Template;

/// A camera in whose pictures a bead lies on the glass.
struct Glass<C> {
    inner: C,
    template: Template,
    places_px: Vec<(f64, f64)>,
    /// Whether the pictures show nothing else.
    alone: bool,
}

impl<C: Camera> Camera for Glass<C> {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        let stamp = self.inner.next_frame(buffer, deadline_ns)?;
        if stamp.is_some() {
            let mut glass = vec![0.0_f32; buffer.width * buffer.height];
            for (x, y) in &self.places_px {
                self.template.draw(&mut glass, buffer.width, *x, *y, 100.0);
            }
            for (k, (pixel, glass)) in buffer.mono8.iter_mut().zip(&glass).enumerate() {
                let grey = if self.alone {
                    100.0 + f32::from((k as u8).wrapping_mul(*pixel) % 5)
                } else {
                    f32::from(*pixel)
                };
                *pixel = (grey + glass).round().clamp(0.0, 255.0) as u8;
            }
        }
        Ok(stamp)
    }
    fn info(&self) -> SourceInfo {
        self.inner.info()
    }
}

#[derive(Default)]
struct Kept {
    events: Vec<EventKind>,
    error_um: f64,
}

impl RunSink for Kept {
    fn tick(&mut self, record: &TickRecord) {
        self.error_um = record.measured_um - record.true_um;
    }
    fn event(&mut self, event: &Event) {
        self.events.push(event.kind);
    }
    fn progress(&mut self, _: &Statistics) {}
}

fn run(places_px: &[(f64, f64)], alone: bool) -> (cellpos_session::Ended, Kept) {
    let mut file = RigFile::default();
    file.emulator.start_um = 3.0;
    file.emulator.height_px = 96;
    let places_px = places_px.to_vec();
    let source = |file: &RigFile, emulated: &EmulatedRig, clock: &Clock| {
        let localiser = file.localiser().expect("the default look");
        let camera = Glass {
            inner: emulated.camera(),
            template: localiser.template().clone(),
            places_px,
            alone,
        };
        file.watch(camera, clock).expect("a camera")
    };
    let ran = run_on(source, file, Frames::On, "pi", hold(), 3000);
    (ran.ended, ran.sink)
}

#[test]
fn beads_on_the_glass_are_left_for_the_one_that_moves_with_the_pzt() {
    let (ended, kept) = run(&[(60.0, 20.0), (190.0, 76.0)], false);
    assert_eq!(ended.kind, EndKind::Done, "{ended}");
    let rejected = |event: &&EventKind| matches!(event, EventKind::ArmingRejected { .. });
    assert!(
        kept.events.iter().any(|event| rejected(&event)),
        "{:?}",
        kept.events
    );
    assert!(kept.error_um.abs() < 0.1, "{}", kept.error_um);
}

#[test]
fn with_beads_on_the_glass_alone_arming_is_refused_for_want_of_an_answer() {
    let (ended, kept) = run(&[(60.0, 20.0), (190.0, 76.0)], true);
    let refused = kept.events.iter().find_map(|event| match event {
        EventKind::ArmingRefused { refusal, .. } => Some(*refusal),
        _ => None,
    });
    assert_eq!(
        refused,
        Some(Refusal::NoResponse),
        "{ended} {:?}",
        kept.events
    );
    let rejected = |event: &&EventKind| matches!(event, EventKind::ArmingRejected { .. });
    assert_eq!(kept.events.iter().filter(rejected).count(), 2);
}
