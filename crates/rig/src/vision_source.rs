//! A camera with a tracker: frames in, positions of one and the same bead, or cell, out.
//!
//! The tracker predicts the bead from the commanded flow, takes a fix only when place, intensity, size and residual
//! agree, and says of every frame where it stands and why. A fix that it does not take gives no position, so that the
//! loop coasts rather than follows another bead. Of a cell, length and area come with the position.

use crate::calibration::{Axis, Calibration};
use crate::clock::Clock;
use crate::flow::CommandedFlow;
use crate::measurement::Measurement;
use crate::source::{Camera, CameraError, FrameBuffer, FrameStamp, PositionSource, SourceInfo};
use cellpos_vision::{
    Cell, CellTracker, Commanded, Decision, Frame, TrackState, TrackStep, Tracker, Verdict,
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

    fn state(&self) -> TrackState {
        match self {
            Self::Bead(tracker) => tracker.state(),
            Self::Cell(tracker) => tracker.state(),
        }
    }

    fn step(
        &mut self,
        frame: &Frame,
        time_s: f64,
        commanded: Commanded,
    ) -> Result<(TrackStep, Option<Cell>), cellpos_vision::CellError> {
        match self {
            Self::Bead(tracker) => Ok((tracker.step(Some(frame), time_s, commanded), None)),
            Self::Cell(tracker) => {
                let step = tracker.step(Some(frame), time_s, commanded)?;
                Ok((step.track, step.cell))
            }
        }
    }
}

/// A camera with a tracker. Allocates nothing per frame once it runs.
#[derive(Debug)]
pub struct VisionSource<C> {
    camera: C,
    followed: Followed,
    calibration: Calibration,
    clock: Clock,
    flow: Option<CommandedFlow>,
    buffer: FrameBuffer,
    /// Time stamp of the first frame: the tracker's times count from it.
    first_ns: Option<i64>,
    /// Id and time stamp of the newest frame looked at.
    newest: Option<(u64, i64)>,
}

impl<C: Camera> VisionSource<C> {
    /// Joins a camera and a tracker. Without [`VisionSource::with_flow`] the prediction knows no commands.
    pub fn new(
        camera: C,
        tracker: impl Into<Followed>,
        calibration: Calibration,
        clock: Clock,
    ) -> Self {
        Self {
            camera,
            followed: tracker.into(),
            calibration,
            clock,
            flow: None,
            buffer: FrameBuffer::default(),
            first_ns: None,
            newest: None,
        }
    }

    /// Lets the tracker predict from what is commanded.
    pub fn with_flow(mut self, flow: CommandedFlow) -> Self {
        self.flow = Some(flow);
        self
    }

    /// Of several beads or cells, the one nearest to this position at the start is followed; without it the most prominent.
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

    /// Looks at the frame in the buffer; `None` for one that came twice, late, or with an old time stamp.
    fn look(
        &mut self,
        stamp: &FrameStamp,
    ) -> Result<Option<(TrackStep, Option<Cell>)>, CameraError> {
        let at_ns = stamp.mid_exposure_ns;
        let before = self.newest;
        if before.is_some_and(|(id, ns)| stamp.id <= id || at_ns <= ns) {
            return Ok(None);
        }
        self.newest = Some((stamp.id, at_ns));
        let first_ns = *self.first_ns.get_or_insert(at_ns);
        let mean_px_per_s = |from_ns, to_ns| {
            let um_per_s = self
                .flow
                .as_ref()
                .map_or(0.0, |flow| flow.mean_um_per_s(from_ns, to_ns));
            self.calibration.flow_px_per_s(um_per_s)
        };
        let exposed_s = stamp.exposure_ns as f64 * 1e-9;
        let half_ns = stamp.exposure_ns / 2;
        let (x, y) = mean_px_per_s(at_ns - half_ns, at_ns + half_ns);
        let commanded = Commanded {
            flow_px_per_s: before
                .map_or((0.0, 0.0), |(_, before_ns)| mean_px_per_s(before_ns, at_ns)),
            streak_px: (x * exposed_s, y * exposed_s),
        };
        let time_s = (at_ns - first_ns) as f64 * 1e-9;
        self.followed
            .step(&self.buffer.frame(), time_s, commanded)
            .map(Some)
            .map_err(|error| CameraError::Broken {
                camera: self.camera.info().name,
                problem: error.to_string(),
                remedy:
                    "record the background again, as this camera is set now: cellpos background"
                        .to_string(),
            })
    }
}

impl<C: Camera> PositionSource for VisionSource<C> {
    fn next(&mut self, deadline_ns: i64) -> Result<Option<Measurement>, CameraError> {
        let Some(stamp) = self.camera.next_frame(&mut self.buffer, deadline_ns)? else {
            return Ok(None);
        };
        let (step, cell) = match self.look(&stamp)? {
            Some((step, cell)) => (Some(step), cell),
            None => (None, None),
        };
        let fix = step.map(|s| s.fix);
        let taken = step.filter(|s| s.decision.is_accepted()).map(|s| s.fix);
        let c = &self.calibration;
        Ok(Some(Measurement {
            frame_id: stamp.id,
            mid_exposure_ns: stamp.mid_exposure_ns,
            ready_ns: self.clock.now_ns(),
            position_um: taken.map_or(f64::NAN, |f| c.position_um(f.x_px, f.y_px)),
            variance_um2: taken.map_or(f64::NAN, |f| {
                c.variance_um2(f.var_x_px2, f.var_y_px2, f.cov_xy_px2)
            }),
            verdict: fix.map_or(Verdict::NoSignal, |f| f.verdict),
            track: Some(step.map_or((self.followed.state(), Decision::Stale), |s| {
                (s.state, s.decision)
            })),
            length_um: cell.map_or(f64::NAN, |cell| c.length_um(&cell)),
            area_um2: cell.map_or(f64::NAN, |cell| c.area_um2(&cell)),
            snr: fix.map_or(f64::NAN, |f| f.snr),
            true_um: stamp.true_um,
            true_pzt_um: stamp.true_pzt_um,
        }))
    }

    fn info(&self) -> SourceInfo {
        let mut info = self.camera.info();
        info.field_um = self.calibration.field_um(info.width_px, info.height_px);
        info
    }
}
