//! A camera with a tracker: turns frames into positions of one bead or cell.
//!
//! The tracker predicts the bead from the commanded flow. It accepts a fix only if place, intensity, size and residual agree, and
//! reports its state and reason for every frame. A refused fix gives no position, so that the loop coasts instead of following
//! another bead. A cell's position comes with length and area.

use crate::calibration::{Axis, Calibration};
use crate::flow::CommandedFlow;
use cellpos_rig::clock::Clock;
use cellpos_rig::freshness::{FrameAccount, IdKind};
use cellpos_rig::measurement::Measurement;
use cellpos_rig::source::{
    Camera, CameraError, FrameBuffer, FrameStamp, FrameWatch, PositionSource, Rejections,
    SeenFrame, SourceInfo,
};
use cellpos_vision::{
    Cell, CellTracker, Commanded, Decision, Fix, FixQuality, Frame, TrackState, TrackStep, Tracker,
};

/// What is followed.
#[derive(Debug)]
pub enum Followed {
    /// A bead.
    Bead(Box<Tracker>),
    /// A cell.
    Cell(Box<CellTracker>),
}

impl From<Tracker> for Followed {
    fn from(tracker: Tracker) -> Self {
        Self::Bead(Box::new(tracker))
    }
}

impl From<CellTracker> for Followed {
    fn from(tracker: CellTracker) -> Self {
        Self::Cell(Box::new(tracker))
    }
}

impl Followed {
    fn choose(&mut self, aim_px: (f64, f64)) {
        match self {
            Self::Bead(tracker) => tracker.choose(Some(aim_px)),
            Self::Cell(tracker) => tracker.choose(Some(aim_px)),
        }
    }

    fn search_anew(&mut self) {
        match self {
            Self::Bead(tracker) => tracker.search_anew(),
            Self::Cell(tracker) => tracker.search_anew(),
        }
    }

    fn reject(&mut self) {
        match self {
            Self::Bead(tracker) => tracker.reject(),
            Self::Cell(tracker) => tracker.reject(),
        }
    }

    fn state(&self) -> TrackState {
        match self {
            Self::Bead(tracker) => tracker.state(),
            Self::Cell(tracker) => tracker.state(),
        }
    }

    /// Half the width of the mark around it, px.
    fn half_px(&self, cell: Option<&Cell>) -> (f64, f64) {
        match self {
            Self::Bead(tracker) => {
                let radius_px = tracker.localiser().template().radius_px();
                (radius_px, radius_px)
            }
            Self::Cell(_) => cell.map_or((f64::NAN, f64::NAN), |cell| {
                let along = |direction| 0.5 * cell.extent_px(direction);
                (along((1.0, 0.0)), along((0.0, 1.0)))
            }),
        }
    }

    /// Outline of the accepted cell, px; empty for a bead.
    fn outline(&self, cell: Option<&Cell>) -> &[(f64, f64)] {
        match (self, cell) {
            (Self::Cell(tracker), Some(cell)) => tracker.outline(cell),
            _ => &[],
        }
    }

    /// The object in a frame; [`Followed::look_beside`] looks at what else is there.
    fn step(
        &mut self,
        frame: &Frame,
        time_s: f64,
        commanded: Commanded,
    ) -> Result<(TrackStep, Option<Cell>), cellpos_vision::CellError> {
        match self {
            Self::Bead(tracker) => {
                let step = tracker.step_at_once(Some(frame), time_s, commanded);
                Ok((step, None))
            }
            Self::Cell(tracker) => {
                let step = tracker.step(Some(frame), time_s, commanded)?;
                Ok((step.track, step.cell))
            }
        }
    }

    /// Looks at what else is in the last frame, if that is due; whether it was.
    fn look_beside(&mut self, frame: &Frame) -> bool {
        match self {
            Self::Bead(tracker) => tracker.look_beside(frame),
            Self::Cell(_) => false,
        }
    }
}

/// A camera with a tracker. Allocates nothing per frame once it runs.
pub struct VisionSource<C> {
    camera: C,
    followed: Followed,
    calibration: Calibration,
    clock: Clock,
    flow: Option<CommandedFlow>,
    rejections: Rejections,
    /// How many of the rejections have been heard.
    rejected: u32,
    buffer: FrameBuffer,
    /// The frame before.
    before: FrameBuffer,
    /// Pictures without noise may be equal.
    noise_free: bool,
    /// Time stamp of the first frame: the tracker's times count from it.
    first_ns: Option<i64>,
    account: FrameAccount,
    /// Time stamp of the newest frame looked at.
    newest_ns: Option<i64>,
    /// From frame to frame.
    period_ns: i64,
    /// How long the last look took, ns.
    look_ns: i64,
    /// A frame that has come and waits in `ahead`.
    waiting: Option<FrameStamp>,
    ahead: FrameBuffer,
    /// Where the last look expected the object, px, and its standard deviation.
    expected: ((f64, f64), f64),
    watches: Vec<Box<dyn FrameWatch>>,
}

impl<C: std::fmt::Debug> std::fmt::Debug for VisionSource<C> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VisionSource")
            .field("camera", &self.camera)
            .field("followed", &self.followed)
            .field("calibration", &self.calibration)
            .field("watches", &self.watches.len())
            .finish_non_exhaustive()
    }
}

impl<C: Camera> VisionSource<C> {
    /// Joins a camera and a tracker. Without [`VisionSource::with_flow`] the prediction knows no commands.
    pub fn new(
        camera: C,
        tracker: impl Into<Followed>,
        calibration: Calibration,
        clock: Clock,
    ) -> Self {
        // A source without a stated rate counts as one frame per millisecond.
        let rate_hz = camera.info().rate_hz;
        let period_ns = if rate_hz > 0.0 {
            (1e9 / rate_hz) as i64
        } else {
            1_000_000
        };
        Self {
            // A frame that arrived too old still informs the tracker of the bead's motion.
            account: FrameAccount::new(IdKind::Wide, period_ns, i64::MAX),
            camera,
            followed: tracker.into(),
            calibration,
            clock,
            flow: None,
            rejections: Rejections::default(),
            rejected: 0,
            buffer: FrameBuffer::default(),
            before: FrameBuffer::default(),
            noise_free: false,
            first_ns: None,
            newest_ns: None,
            period_ns,
            look_ns: 0,
            waiting: None,
            ahead: FrameBuffer::default(),
            expected: ((f64::NAN, f64::NAN), f64::INFINITY),
            watches: Vec::new(),
        }
    }

    /// Lets the tracker predict from the commands.
    pub fn with_flow(mut self, flow: CommandedFlow) -> Self {
        self.flow = Some(flow);
        self
    }

    /// Declares that the camera's pictures have no noise, so two may be equal. Pictures of a real camera never are, because shot
    /// noise does not repeat: equal ones come from a hanging grabber or driver and count as stale.
    pub fn noise_free(mut self) -> Self {
        self.noise_free = true;
        self
    }

    /// If there are several beads or cells at the start, tracks the one nearest to this position; without it, the most prominent.
    pub fn near(mut self, position_um: f64) -> Self {
        let info = self.camera.info();
        let across_px = match self.calibration.axis {
            Axis::X => 0.5 * info.height_px.saturating_sub(1) as f64,
            Axis::Y => 0.5 * info.width_px.saturating_sub(1) as f64,
        };
        self.followed
            .choose(self.calibration.point_px(position_um, across_px));
        self
    }

    /// Whether the frame in the buffer is new ([`FrameAccount`]) and does not repeat the picture before.
    fn is_new(&mut self, stamp: &FrameStamp) -> bool {
        let judged = self
            .account
            .step(stamp.id, stamp.mid_exposure_ns, stamp.arrival_ns);
        // The comparison ends at the first pixel that differs.
        judged.kind.is_new() && (self.noise_free || self.buffer != self.before)
    }

    /// Processes the frame in the buffer.
    fn look(&mut self, stamp: &FrameStamp) -> Result<(TrackStep, Option<Cell>), CameraError> {
        let from_ns = self.clock.now_ns();
        let at_ns = stamp.mid_exposure_ns;
        let before_ns = self.newest_ns.replace(at_ns);
        let first_ns = *self.first_ns.get_or_insert_with(|| {
            // Its size is known now: nothing is allocated later.
            self.ahead.clone_from(&self.buffer);
            at_ns
        });
        let mean_px_per_s = |from_ns, to_ns| {
            let um_per_s = self
                .flow
                .as_ref()
                .map_or(0.0, |flow| flow.mean_um_per_s(from_ns, to_ns));
            self.calibration.flow_px_per_s(um_per_s)
        };
        let exposed_s = stamp.exposure_ns as f64 * 1e-9;
        let half_ns = stamp.exposure_ns / 2;
        let first = mean_px_per_s(at_ns - half_ns, at_ns);
        let second = mean_px_per_s(at_ns, at_ns + half_ns);
        let half_s = 0.5 * exposed_s;
        let commanded = Commanded {
            flow_px_per_s: before_ns
                .map_or((0.0, 0.0), |before_ns| mean_px_per_s(before_ns, at_ns)),
            streak_px: (half_s * (first.0 + second.0), half_s * (first.1 + second.1)),
            turn_px: (half_s * (second.0 - first.0), half_s * (second.1 - first.1)),
            exposure_s: exposed_s,
        };
        let time_s = (at_ns - first_ns) as f64 * 1e-9;
        let seen = self
            .followed
            .step(&self.buffer.frame(), time_s, commanded)
            .map_err(|error| CameraError::Broken {
                camera: self.camera.info().name,
                problem: error.to_string(),
                remedy:
                    "record the background again, as this camera is set now: cellpos background"
                        .to_string(),
            })?;
        self.expected = ((seen.0.x_px, seen.0.y_px), seen.0.sd_px);
        self.look_ns = self.clock.now_ns() - from_ns;
        Ok(seen)
    }

    /// Looks at what else is in the frame in the buffer, whose position has been given.
    fn look_beside(&mut self) {
        let from_ns = self.clock.now_ns();
        if self.followed.look_beside(&self.buffer.frame()) {
            self.look_ns += self.clock.now_ns() - from_ns;
        }
    }

    /// The next frame, in the buffer; the one before it goes to `before`. `None` if none came in time.
    fn take(&mut self, deadline_ns: i64) -> Result<Option<FrameStamp>, CameraError> {
        std::mem::swap(&mut self.buffer, &mut self.before);
        if let Some(stamp) = self.waiting.take() {
            std::mem::swap(&mut self.buffer, &mut self.ahead);
            return Ok(Some(stamp));
        }
        let taken = self.camera.next_frame(&mut self.buffer, deadline_ns)?;
        if taken.is_none() {
            std::mem::swap(&mut self.buffer, &mut self.before);
        }
        Ok(taken)
    }

    /// Whether a newer frame than the one in the buffer has come already, so that a look at this one would only make the newer one old.
    /// Asked after a look that took longer than a frame: the frames that come during such looks can never all be looked at.
    fn is_overtaken(&mut self) -> bool {
        if self.look_ns > self.period_ns {
            // A camera that has ended says so again when the frame in the buffer has been dealt with.
            self.waiting = self.camera.next_frame(&mut self.ahead, 0).unwrap_or(None);
        }
        self.waiting.is_some()
    }
}

impl<C: Camera> VisionSource<C> {
    fn show(&mut self, stamp: &FrameStamp, taken: Option<&Fix>, cell: Option<&Cell>) {
        if self.watches.is_empty() {
            return;
        }
        let seen = SeenFrame {
            frame: self.buffer.frame(),
            bits: self.buffer.bits,
            stamp: *stamp,
            centre_px: taken.map(|fix| (fix.x_px, fix.y_px)),
            half_px: self.followed.half_px(cell),
            outline_px: self.followed.outline(cell),
            expected_px: self.expected.0,
            expected_sd_px: self.expected.1,
            scale: self.calibration.picture_scale(),
        };
        for watch in &mut self.watches {
            watch.frame(&seen);
        }
    }
}

impl<C: Camera> PositionSource for VisionSource<C> {
    fn next(&mut self, deadline_ns: i64) -> Result<Option<Measurement>, CameraError> {
        let rejected = self.rejections.count();
        if std::mem::replace(&mut self.rejected, rejected) != rejected {
            self.followed.reject();
        }
        self.look_beside();
        let Some(stamp) = self.take(deadline_ns)? else {
            return Ok(None);
        };
        let (mut decision, mut step, mut cell) = (Decision::Stale, None, None);
        if self.is_new(&stamp) {
            if self.is_overtaken() {
                decision = Decision::PassedOver;
            } else {
                let (seen, of_cell) = self.look(&stamp)?;
                (decision, step, cell) = (seen.decision, Some(seen), of_cell);
            }
        }
        let fix = step.map(|s| s.fix);
        let taken = fix.filter(|_| decision.is_accepted());
        if decision != Decision::Stale {
            self.show(&stamp, taken.as_ref(), cell.as_ref());
        }
        let c = &self.calibration;
        Ok(Some(Measurement {
            frame_id: stamp.id,
            mid_exposure_ns: stamp.mid_exposure_ns,
            ready_ns: self.clock.now_ns(),
            position_um: taken.map_or(f64::NAN, |f| c.position_um(f.x_px, f.y_px)),
            variance_um2: taken.map_or(f64::NAN, |f| {
                c.variance_um2(f.var_x_px2, f.var_y_px2, f.cov_xy_px2)
            }),
            verdict: fix.map_or(FixQuality::NoSignal, |f| f.verdict),
            track: Some((step.map_or(self.followed.state(), |s| s.state), decision)),
            length_um: cell.map_or(f64::NAN, |cell| c.length_um(&cell)),
            area_um2: cell.map_or(f64::NAN, |cell| c.area_um2(&cell)),
            length_sd_um: cell.map_or(f64::NAN, |cell| c.length_sd_um(&cell)),
            area_sd_um2: cell.map_or(f64::NAN, |cell| c.area_sd_um2(&cell)),
            snr: fix.map_or(f64::NAN, |f| f.snr),
            true_um: stamp.true_um,
            true_pzt_um: stamp.true_pzt_um,
        }))
    }

    fn truth_um(&mut self) -> f64 {
        self.camera.truth_um()
    }

    fn begin(&mut self) {
        if self.followed.state() == TrackState::Lost {
            self.followed.search_anew();
        }
    }

    fn rejections(&self) -> Option<Rejections> {
        Some(self.rejections.clone())
    }

    fn info(&self) -> SourceInfo {
        let mut info = self.camera.info();
        info.field_um = self.calibration.field_um(info.width_px, info.height_px);
        info
    }

    fn watch(&mut self, watch: Box<dyn FrameWatch>) -> bool {
        self.watches.push(watch);
        true
    }
}
