//! All beads of a frame at once, with numbers that stay with them: for recordings, not for the loop.
//!
//! Every bead that the detector sees is fitted and given to the nearest prediction within the gate, the surest pairs
//! first. A bead that was not seen for a while and comes back gets a new number: a number never changes its bead
//! knowingly.

use crate::detector::Detector;
use crate::fix::{Fix, FixQuality, squared};
use crate::frame::Frame;
use crate::localiser::Localiser;

/// Most beads whose look is remembered.
const MOST_REMEMBERED: usize = 2000;

/// How beads are linked from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkConfig {
    /// Farthest that a bead moves between frames, px.
    pub max_step_px: f64,
    /// Frames without a bead after which its number is given up.
    pub memory_frames: u32,
    /// Most beads in a frame.
    pub max_beads: usize,
}

/// A bead in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// Number of the bead, from 0 in the order of appearance.
    pub bead: u32,
    /// Its fix, of any verdict.
    pub fix: Fix,
}

#[derive(Debug, Clone, Copy)]
struct Track {
    bead: u32,
    x_px: f64,
    y_px: f64,
    missed: u32,
    seen: bool,
}

/// Locates and numbers all beads.
#[derive(Debug, Clone)]
pub struct ManyTracker {
    config: LinkConfig,
    localiser: Localiser,
    detector: Detector,
    tracks: Vec<Track>,
    next: u32,
    sights: Vec<Sight>,
    refused: Vec<Fix>,
}

impl ManyTracker {
    /// A tracker without beads.
    pub fn new(mut localiser: Localiser, config: LinkConfig) -> Self {
        localiser.remember_beads(config.max_beads.min(MOST_REMEMBERED));
        let detector = Detector::thorough(&localiser, config.max_beads);
        ManyTracker {
            config,
            localiser,
            detector,
            tracks: Vec::new(),
            next: 0,
            sights: Vec::new(),
            refused: Vec::new(),
        }
    }

    /// The localiser in use.
    pub fn localiser(&self) -> &Localiser {
        &self.localiser
    }

    /// Beads of the last frame, by number.
    pub fn sights(&self) -> &[Sight] {
        &self.sights
    }

    /// Objects of the last frame without a number: fits that are not good, and of no known bead.
    pub fn refused(&self) -> &[Fix] {
        &self.refused
    }

    /// Whether the last frame held more than there was room for: then beads may have been left out.
    pub fn is_crowded(&self) -> bool {
        self.detector.left_out() > 0
    }

    /// Beads of the frame, by number.
    pub fn step(&mut self, frame: &Frame) -> &[Sight] {
        self.sights.clear();
        self.refused.clear();
        self.detector.detect(frame);
        let mut fixes: Vec<Fix> = Vec::new();
        let found = self.detector.found().iter().take(self.config.max_beads);
        let places = found.map(|blob| (blob.x_px, blob.y_px));
        self.localiser.locate_all(frame, places, &mut fixes);
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (t, track) in self.tracks.iter().enumerate() {
            // The longer a bead was missed, the farther it may have gone.
            let most_px2 = self.config.max_step_px.powi(2) * f64::from(1 + track.missed);
            for (f, fix) in fixes.iter().enumerate() {
                let step_px2 = squared(fix.x_px - track.x_px, fix.y_px - track.y_px);
                if step_px2 <= most_px2 {
                    pairs.push((step_px2, t, f));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut owner: Vec<Option<usize>> = vec![None; fixes.len()];
        self.tracks.iter_mut().for_each(|t| t.seen = false);
        for (_, t, f) in pairs {
            let track = &mut self.tracks[t];
            if !track.seen && owner[f].is_none() {
                owner[f] = Some(t);
                track.seen = true;
                (track.x_px, track.y_px, track.missed) = (fixes[f].x_px, fixes[f].y_px, 0);
            }
        }
        for (fix, owner) in fixes.into_iter().zip(owner) {
            let bead = match owner {
                Some(t) => self.tracks[t].bead,
                // A number is given only to what looks like a bead.
                None if fix.verdict == FixQuality::Good => {
                    let bead = self.next;
                    self.next += 1;
                    self.tracks.push(Track {
                        bead,
                        x_px: fix.x_px,
                        y_px: fix.y_px,
                        missed: 0,
                        seen: true,
                    });
                    bead
                }
                None => {
                    self.refused.push(fix);
                    continue;
                }
            };
            self.sights.push(Sight { bead, fix });
        }
        let memory = self.config.memory_frames;
        for t in &mut self.tracks {
            t.missed += u32::from(!t.seen);
        }
        self.tracks.retain(|t| t.missed <= memory);
        self.sights.sort_by_key(|s| s.bead);
        &self.sights
    }
}
