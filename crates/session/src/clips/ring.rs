//! The frames of the last seconds, and the moments that wait for their last frames.

use super::moment::Moment;
use std::collections::VecDeque;

/// A part of a frame.
#[derive(Debug, Default)]
pub(super) struct Shot {
    pub(super) id: u64,
    /// Middle of its exposure by the rig's clock, ns.
    pub(super) stamp_ns: i64,
    pub(super) pixels: Vec<u16>,
    /// Whether the camera sends more than 8 bits.
    pub(super) deep: bool,
    pub(super) width: usize,
    pub(super) height: usize,
    /// Its place in the camera's picture: column, row.
    pub(super) origin_px: (usize, usize),
    /// Position of the bead or cell in it; NaN if it was not seen.
    pub(super) centre_px: (f64, f64),
}

impl Shot {
    pub(super) fn with_room(pixels: usize) -> Self {
        Self {
            pixels: Vec::with_capacity(pixels),
            ..Self::default()
        }
    }

    /// When it was exposed, s of the run, which began `offset_ns` by the rig's clock.
    pub(super) fn time_s(&self, offset_ns: i64) -> f64 {
        (self.stamp_ns - offset_ns) as f64 * 1e-9
    }
}

/// Frames in the order of their exposure, and moments that still wait for frames.
#[derive(Debug)]
pub(super) struct Ring {
    shots: VecDeque<Shot>,
    /// Most frames to keep, so that buffers remain for the frames that come meanwhile.
    most: usize,
    before_ns: i64,
    after_ns: i64,
    waiting: VecDeque<Moment>,
}

impl Ring {
    pub(super) fn new(before_s: f64, after_s: f64, buffers: usize) -> Self {
        Self {
            shots: VecDeque::new(),
            most: (buffers - buffers / 8).max(1),
            before_ns: (before_s * 1e9) as i64,
            after_ns: (after_s * 1e9) as i64,
            waiting: VecDeque::new(),
        }
    }

    /// Takes a frame; returns the oldest if there are too many.
    pub(super) fn push(&mut self, shot: Shot) -> Option<Shot> {
        self.shots.push_back(shot);
        if self.shots.len() > self.most {
            self.shots.pop_front()
        } else {
            None
        }
    }

    pub(super) fn expect(&mut self, moment: Moment) {
        self.waiting.push_back(moment);
    }

    /// From the time of the run to the rig's clock, ns: by the frame that the loop used at that moment, or the newest older one.
    pub(super) fn offset_ns(&self, moment: &Moment) -> i64 {
        let (id, in_run_ns) = moment.frame;
        let known = self.shots.iter().rev().find(|shot| shot.id <= id);
        let known = known.or(self.shots.front());
        known.map_or(0, |shot| shot.stamp_ns - in_run_ns)
    }

    /// The next moment whose last frame is here; once no frame will come any more, each waiting moment.
    pub(super) fn next_ready(&mut self, last: bool) -> Option<Moment> {
        let moment = self.waiting.front()?;
        let newest_ns = self.shots.back().map(|shot| shot.stamp_ns);
        let until_ns = self.offset_ns(moment) + moment.at_ns + self.after_ns;
        let complete = newest_ns.is_some_and(|ns| ns >= until_ns);
        if complete || last {
            self.waiting.pop_front()
        } else {
            None
        }
    }

    /// The frames around a moment.
    pub(super) fn about(&self, moment: &Moment) -> Vec<&Shot> {
        let at_ns = self.offset_ns(moment) + moment.at_ns;
        let span = at_ns - self.before_ns..=at_ns + self.after_ns;
        self.shots
            .iter()
            .filter(|shot| span.contains(&shot.stamp_ns))
            .collect()
    }
}
