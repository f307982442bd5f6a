//! The live page of a PZT that is moved by hand: its displacement, the camera's picture, freeze and park.

use crate::outcome::Failure;
use crate::view_args;
use cellpos_drivers::Calibration;
use cellpos_rig::{Camera, Clock, FrameBuffer, FrameStamp, FrameWatch, PictureScale, SeenFrame};
use cellpos_runtime::Request;
use cellpos_runtime::live::Operator;
use cellpos_session::view::{ByHand, HandStep, Hello, View, Wanted};
use cellpos_workbench::Bench;
use cellpos_workbench::mover::Mover;
use cellpos_workbench::snapshot::{Eye, Seen};
use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;

/// How long a frame may let the camera's thread wait, ns.
const PATIENCE_NS: i64 = 200_000_000;

/// What the operator's page asks for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Asked {
    /// Nothing.
    Nothing,
    /// To stand still until it is told to go on.
    Freeze,
    /// To end.
    Park,
    /// To go to a displacement, um.
    To(f64),
}

/// The page and its source.
pub(super) struct Shown {
    by_hand: ByHand,
    operator: Arc<Operator>,
    /// What was taken up of the operator's targets last, um.
    taken_um: Cell<Option<f64>>,
    start_ns: i64,
    looking: Option<Looking>,
    // Behind what feeds it.
    _view: View,
}

impl Shown {
    /// Serves the page, if one is wanted; `blind`: without the camera.
    pub(super) fn open(
        wanted: &Wanted,
        bench: &Bench,
        blind: bool,
    ) -> Result<Option<Self>, Failure> {
        if !wanted.is_any() {
            return Ok(None);
        }
        let file = bench.file();
        let mut camera = if blind { None } else { Some(bench.camera()?) };
        let hello = Hello {
            name: "jog".to_string(),
            subtitle: "jog: the PZT is moved by hand, no loop is closed".to_string(),
            range_um: [file.limits.low_um, file.limits.high_um],
            slew_um_per_s: file.limits.slew_um_per_s,
            steered: true,
            by_hand: true,
            notes: false,
            pictures: camera.is_some(),
            ..Hello::default()
        };
        let operator = Arc::new(Operator::default());
        let mut view = View::open(wanted, hello, &operator)?;
        view_args::said(&view);
        let pictures = view.pictures();
        let looking = match (camera.take(), pictures) {
            (Some(camera), Some(pictures)) => {
                let eye = Eye::of(bench).ok();
                Some(Looking::start(camera, eye, file.calibration, pictures)?)
            }
            _ => None,
        };
        let Some(by_hand) = ByHand::of(&mut view) else {
            return Ok(None);
        };
        Ok(Some(Self {
            by_hand,
            operator,
            taken_um: Cell::new(None),
            start_ns: Clock::Real.now_ns(),
            looking,
            _view: view,
        }))
    }

    /// Request of the operator; a target is reported once.
    pub(super) fn asked(&self) -> Asked {
        match self.operator.asked() {
            Request::None | Request::Skip => {}
            Request::Pause => return Asked::Freeze,
            Request::Freeze | Request::Park | Request::Unrecorded => return Asked::Park,
        }
        let target_um = self.operator.target_um();
        if target_um == self.taken_um.get() {
            return Asked::Nothing;
        }
        self.taken_um.set(target_um);
        target_um.map_or(Asked::Nothing, Asked::To)
    }

    /// Shows one millisecond.
    pub(super) fn step(&mut self, mover: &Mover) {
        let time_ns = Clock::Real.now_ns() - self.start_ns;
        let seen = self.looking.as_mut().and_then(Looking::newest);
        let (state, reason) = match self.operator.asked() {
            Request::Pause => ("frozen", "The PZT stands still until you continue."),
            Request::Freeze | Request::Park => ("safe", "The PZT parks: it was asked for."),
            _ => ("running", "The PZT is moved by hand; no loop is closed."),
        };
        let step = HandStep {
            time_ns,
            command_um: mover.at_um(),
            bead_um: seen.and_then(|seen| seen.position_um).unwrap_or(f64::NAN),
            wake_us: 0.0,
        };
        self.by_hand.step(&step, state, reason);
    }

    /// What is seen at a stop. The PZT is held meanwhile.
    pub(super) fn look(&mut self, mover: &mut Mover, to_um: f64) -> Result<Option<Seen>, Failure> {
        /// How long a bead is looked for, ms.
        const LOOK_MS: u32 = 100;
        let mut seen = None;
        if let Some(looking) = &mut self.looking {
            // What was seen on the way does not count.
            looking.newest = None;
        }
        for _ in 0..LOOK_MS {
            mover.step(to_um, f64::INFINITY)?;
            self.step(mover);
            seen = self.looking.as_ref().and_then(|looking| looking.newest);
            if seen.is_some() || self.looking.is_none() {
                break;
            }
        }
        Ok(seen)
    }

    /// Tells what was found.
    pub(super) fn tell(&mut self, text: &str) {
        let time_ns = Clock::Real.now_ns() - self.start_ns;
        self.by_hand.tell(time_ns, text.to_string());
    }

    /// It is over: the PZT is at park or on its way there.
    pub(super) fn over(self) {
        self.by_hand.over("the PZT is parked.");
    }
}

/// The camera while the PZT is moved: each frame to the page, and what was seen in it.
struct Looking {
    newest: Option<Seen>,
    seen: Receiver<Option<Seen>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Looking {
    fn start(
        camera: Box<dyn Camera>,
        eye: Option<Eye>,
        calibration: Option<Calibration>,
        pictures: Box<dyn FrameWatch>,
    ) -> Result<Self, Failure> {
        let stop = Arc::new(AtomicBool::new(false));
        let (told, seen) = channel();
        let asked = Arc::clone(&stop);
        let mut eyes = Eyes {
            camera,
            eye,
            calibration,
            pictures,
            told,
        };
        let thread = std::thread::Builder::new()
            .name("cellpos-look".to_string())
            .spawn(move || eyes.serve(&asked))
            .map_err(Failure::failed)?;
        Ok(Self {
            newest: None,
            seen,
            stop,
            thread: Some(thread),
        })
    }

    fn newest(&mut self) -> Option<Seen> {
        if let Some(seen) = self.seen.try_iter().last() {
            self.newest = seen;
        }
        self.newest
    }
}

impl Drop for Looking {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// State of the camera's thread.
struct Eyes {
    camera: Box<dyn Camera>,
    eye: Option<Eye>,
    calibration: Option<Calibration>,
    pictures: Box<dyn FrameWatch>,
    told: Sender<Option<Seen>>,
}

impl Eyes {
    fn serve(&mut self, stop: &AtomicBool) {
        let mut buffer = FrameBuffer::default();
        let mut first_ns = None;
        while !stop.load(Ordering::Acquire) {
            let deadline_ns = Clock::Real.now_ns() + PATIENCE_NS;
            let stamp = match self.camera.next_frame(&mut buffer, deadline_ns) {
                Ok(Some(stamp)) => stamp,
                Ok(None) => continue,
                Err(error) => {
                    tracing::warn!("no more pictures: {error}");
                    return;
                }
            };
            let time_ns = stamp.mid_exposure_ns - *first_ns.get_or_insert(stamp.mid_exposure_ns);
            let look = |eye: &mut Eye| eye.look(&buffer, time_ns as f64 * 1e-9).ok().flatten();
            let seen = self.eye.as_mut().and_then(look);
            self.show(&buffer, stamp, seen.as_ref());
            if self.told.send(seen).is_err() {
                return;
            }
        }
    }

    fn show(&mut self, buffer: &FrameBuffer, stamp: FrameStamp, seen: Option<&Seen>) {
        let half_px = seen.map_or(10.0, |seen| seen.half_px);
        let centre_px = seen.map(|seen| (seen.x_px, seen.y_px));
        self.pictures.frame(&SeenFrame {
            frame: buffer.frame(),
            bits: buffer.bits,
            stamp,
            centre_px,
            half_px: (half_px, half_px),
            outline_px: &[],
            expected_px: centre_px.unwrap_or((f64::NAN, f64::NAN)),
            expected_sd_px: f64::INFINITY,
            scale: self.calibration.map_or(
                PictureScale {
                    first_um: f64::NAN,
                    um_per_px: f64::NAN,
                    upright: false,
                },
                |calibration| calibration.picture_scale(),
            ),
        });
    }
}
