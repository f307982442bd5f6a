//! The camera of the emulated world: exposures, pictures, deliveries and faults.

use crate::config::WorldConfig;
use crate::faults::{FaultKind, Faults};
use cellpos_numeric::Random;
use cellpos_plant::Model;
use cellpos_plant::effects::Action;
use cellpos_vision::FixQuality;
use std::collections::VecDeque;

/// Number of intervals in which the path during an exposure is sampled.
pub(crate) const EXPOSURE_STEPS: usize = 4;
/// Most frames that wait for delivery; beyond that the oldest are lost, as in any camera's buffer.
const QUEUE_LEN: usize = 256;
/// A stale frame shows the picture of this many frames before.
const STALE_BY: usize = 5;

/// Data of a delivered frame besides its pixels. Times are those given to the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameInfo {
    /// Rises by one per exposed frame, from 0.
    pub id: u64,
    /// Middle of the exposure by the camera's own clock, ns.
    pub mid_exposure_ns: i64,
    /// Exposure time, ns.
    pub exposure_ns: i64,
    /// Delivery, ns.
    pub delivery_ns: i64,
    /// True bead position along the channel, mean over the exposure, um.
    pub true_um: f64,
    /// True bead position across the channel, mean over the exposure, um.
    pub true_lateral_um: f64,
    /// Part of the exposure for which the LED was lit, 0..1.
    pub lit: f64,
}

/// A position delivered without a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionFix {
    /// Length of the cell along the channel, um; NaN for a bead.
    pub length_um: f64,
    /// Projected area of the cell, um^2; NaN for a bead, or when it is not measured.
    pub area_um2: f64,
    /// Standard deviation of the length, um; NaN without one.
    pub length_sd_um: f64,
    /// Standard deviation of the area, um^2; NaN without one.
    pub area_sd_um2: f64,
    /// As of the frame that would have been delivered.
    pub info: FrameInfo,
    /// Measured position along the channel, um; NaN unless the verdict is good.
    pub x_um: f64,
    /// Variance of the measured position, um^2; NaN unless the verdict is good.
    pub variance_um2: f64,
    /// Peak contrast over the noise of one background pixel.
    pub snr: f64,
    /// The verdict that vision would give on the picture.
    pub verdict: FixQuality,
}

/// One point of the path: true and apparent position, um.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Sample {
    /// Length of the cell, um; NaN for a bead.
    pub length_um: f64,
    pub true_um: f64,
    pub lateral_um: f64,
    pub seen_um: f64,
    /// Position of a second bead, if there is one.
    pub second_um: Option<(f64, f64)>,
    /// Relative difference of the bead's ring from its size in focus.
    pub defocus: f64,
    pub visible: bool,
    pub lit: bool,
}

/// What one exposure saw.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Exposure {
    pub id: u64,
    pub mid_ns: i64,
    /// The frame grabber hangs: the picture is the one before, to the bit.
    pub frozen: bool,
    pub samples: [Sample; EXPOSURE_STEPS + 1],
}

impl Exposure {
    /// Length of the cell in the middle of the exposure, um; `None` for a bead.
    pub(crate) fn mid_length_um(&self) -> Option<f64> {
        let middle = self.samples.get(EXPOSURE_STEPS / 2)?;
        Some(middle.length_um).filter(|um| um.is_finite())
    }

    /// Relative difference of the bead's ring from its size in focus, in the middle of the exposure.
    pub(crate) fn defocus(&self) -> f64 {
        self.samples
            .get(EXPOSURE_STEPS / 2)
            .map_or(0.0, |middle| middle.defocus)
    }

    pub(crate) fn is_visible(&self) -> bool {
        self.samples.iter().all(|s| s.visible)
    }

    /// Path of the second bead, if it was there for the whole exposure.
    pub(crate) fn second_path(&self) -> Option<[(f64, f64); EXPOSURE_STEPS + 1]> {
        let mut path = [(0.0, 0.0); EXPOSURE_STEPS + 1];
        for (place, sample) in path.iter_mut().zip(&self.samples) {
            *place = sample.second_um?;
        }
        Some(path)
    }
}

#[derive(Debug, Clone, Copy)]
struct Pending {
    exposure: Exposure,
    delivery_ns: i64,
}

#[derive(Debug, Clone)]
pub(crate) struct Camera {
    start_ns: i64,
    period_ns: f64,
    pub(crate) exposure_ns: i64,
    latency_ns: i64,
    faults: Faults,
    next_id: u64,
    samples: [Sample; EXPOSURE_STEPS + 1],
    taken: usize,
    queue: VecDeque<Pending>,
    recent: VecDeque<Exposure>,
    rng: Random,
    strays: Strays,
}

/// Jitter of exposures and arrivals.
#[derive(Debug, Clone)]
struct Strays {
    exposure_ns: f64,
    arrival_ns: f64,
    exposures: Random,
    arrivals: Random,
    /// Delay of the next exposure.
    now_ns: i64,
    /// Earliest arrival of the next frame: no frame overtakes another.
    last_ns: i64,
}

impl Strays {
    fn new(config: &WorldConfig) -> Self {
        let it = config.imperfections();
        let mut strays = Self {
            exposure_ns: it.exposure_jitter_us * 1e3,
            arrival_ns: it.arrival_jitter_us * 1e3,
            exposures: Random::stream(config.seed, 34),
            arrivals: Random::stream(config.seed, 35),
            now_ns: 0,
            last_ns: i64::MIN,
        };
        strays.next_exposure();
        strays
    }

    fn next_exposure(&mut self) {
        // Beyond four standard deviations two exposures could overlap.
        let stray = self.exposures.normal().clamp(-4.0, 4.0);
        self.now_ns = (stray * self.exposure_ns).round() as i64;
    }

    /// Arrival of a frame that could arrive at `fastest_ns`.
    fn arrival_ns(&mut self, fastest_ns: i64) -> i64 {
        let beyond = -(1.0 - self.arrivals.uniform()).ln();
        let arrival_ns = fastest_ns + (beyond * self.arrival_ns) as i64;
        self.last_ns = self.last_ns.max(arrival_ns);
        self.last_ns
    }
}

impl Camera {
    pub(crate) fn new(config: &WorldConfig, model: &Model, start_ns: i64) -> Self {
        let mut camera = Self {
            start_ns,
            period_ns: 1e9 / config.rate_hz
                * (1.0 + 1e-6 * config.imperfections().camera_clock_ppm),
            exposure_ns: (config.exposure_ms * 1e6).round() as i64,
            latency_ns: (config.latency_ms * 1e6).round() as i64,
            faults: config.faults.clone(),
            next_id: 0,
            samples: [Sample::default(); EXPOSURE_STEPS + 1],
            taken: 0,
            queue: VecDeque::with_capacity(QUEUE_LEN + 2),
            recent: VecDeque::with_capacity(STALE_BY + 1),
            rng: Random::stream(config.seed, 20),
            strays: Strays::new(config),
        };
        camera.take_over(model);
        camera
    }

    /// Effects at the camera's place describe this camera and replace the world's own figures.
    fn take_over(&mut self, model: &Model) {
        let mut delay_ns = None;
        for effect in &model.effects {
            match effect.act() {
                Action::Exposure(exposure_s) => {
                    self.exposure_ns = ((exposure_s * 1e9) as i64).min(self.period_ns as i64);
                }
                Action::Delay(delay_s) => delay_ns = Some((delay_s * 1e9).round() as i64),
                Action::Drop(rate) => self.faults.drop_rate = rate,
                Action::Repeat(rate) => self.faults.double_rate = rate,
                Action::Skew(skew) => self.period_ns *= 1.0 + skew,
                _ => {}
            }
        }
        if let Some(delay_ns) = delay_ns {
            // In a model the exposure ends with the frame, so its middle is half an exposure older.
            self.latency_ns = delay_ns + self.exposure_ns / 2;
        }
        self.latency_ns = self.latency_ns.max(self.exposure_ns - self.exposure_ns / 2);
    }

    fn mid_ns(&self, id: u64) -> i64 {
        self.start_ns + ((id + 1) as f64 * self.period_ns).round() as i64
    }

    /// Time of the next sample of the bead.
    pub(crate) fn next_sample_ns(&self) -> i64 {
        self.mid_ns(self.next_id) + self.strays.now_ns - self.exposure_ns / 2
            + self.exposure_ns * self.taken as i64 / EXPOSURE_STEPS as i64
    }

    /// Takes the sample that was due; `true` when it was the last of an exposure.
    pub(crate) fn sample(&mut self, sample: Sample) -> bool {
        if self.exposure_ns == 0 {
            self.samples = [sample; EXPOSURE_STEPS + 1];
            self.taken = EXPOSURE_STEPS;
        } else if let Some(place) = self.samples.get_mut(self.taken) {
            *place = sample;
        }
        if self.taken < EXPOSURE_STEPS {
            self.taken += 1;
            return false;
        }
        self.taken = 0;
        self.expose();
        self.next_id += 1;
        self.strays.next_exposure();
        true
    }

    fn expose(&mut self) {
        let now = Exposure {
            id: self.next_id,
            mid_ns: self.mid_ns(self.next_id),
            frozen: self.faults.active(
                FaultKind::FrozenPicture,
                self.mid_ns(self.next_id) - self.start_ns,
            ),
            samples: self.samples,
        };
        // Draw all four for every frame, so that one rate does not change the random outcome of the others.
        let luck: [f64; 4] = core::array::from_fn(|_| self.rng.uniform());
        let elapsed_ns = now.mid_ns - self.start_ns;
        let hit = |kind, luck: f64, rate: f64| luck < rate || self.faults.active(kind, elapsed_ns);
        let dropped = hit(FaultKind::DropFrames, luck[0], self.faults.drop_rate);
        let stale = hit(FaultKind::StaleFrames, luck[1], self.faults.stale_rate);
        let doubled = hit(FaultKind::DoubleFrames, luck[2], self.faults.double_rate);
        let reordered = luck[3] < self.faults.reorder_rate
            || (now.id.is_multiple_of(2)
                && self.faults.active(FaultKind::ReorderFrames, elapsed_ns));
        let shown = match self.recent.front() {
            Some(old) if stale && self.recent.len() == STALE_BY => Exposure { id: now.id, ..*old },
            _ => now,
        };
        if self.recent.len() == STALE_BY {
            self.recent.pop_front();
        }
        self.recent.push_back(now);
        if dropped {
            return;
        }
        let fastest_ns = now.mid_ns + self.strays.now_ns + self.latency_ns;
        let mut delivery_ns = self.strays.arrival_ns(fastest_ns);
        if reordered {
            delivery_ns += (1.5 * self.period_ns) as i64;
        }
        if let Some(end_ns) = self
            .faults
            .end_ns(FaultKind::StallCamera, delivery_ns - self.start_ns)
        {
            if end_ns == i64::MAX {
                return;
            }
            delivery_ns = self.start_ns + end_ns;
        }
        self.enqueue(shown, delivery_ns);
        if doubled {
            self.enqueue(shown, delivery_ns + (0.5 * self.period_ns) as i64);
        }
    }

    fn enqueue(&mut self, exposure: Exposure, delivery_ns: i64) {
        let place = self
            .queue
            .iter()
            .rposition(|waiting| waiting.delivery_ns <= delivery_ns)
            .map_or(0, |before| before + 1);
        self.queue.insert(
            place,
            Pending {
                exposure,
                delivery_ns,
            },
        );
        if self.queue.len() > QUEUE_LEN {
            self.queue.pop_front();
        }
    }

    /// Delivery time of the next frame that is already exposed.
    pub(crate) fn next_delivery_ns(&self) -> Option<i64> {
        self.queue.front().map(|pending| pending.delivery_ns)
    }

    /// The next frame that has been delivered by `now_ns`.
    pub(crate) fn take(&mut self, now_ns: i64) -> Option<(Exposure, FrameInfo)> {
        if self.next_delivery_ns()? > now_ns {
            return None;
        }
        let Pending {
            exposure,
            delivery_ns,
        } = self.queue.pop_front()?;
        let path = exposure.samples.map(|s| (s.true_um, s.lateral_um));
        let (true_um, true_lateral_um) =
            crate::render::mean_between(&path, 0.0, EXPOSURE_STEPS as f64);
        let light = exposure.samples.map(|s| (f64::from(u8::from(s.lit)), 0.0));
        let (lit, _) = crate::render::mean_between(&light, 0.0, EXPOSURE_STEPS as f64);
        let info = FrameInfo {
            lit,
            id: exposure.id,
            mid_exposure_ns: exposure.mid_ns,
            exposure_ns: self.exposure_ns,
            delivery_ns,
            true_um,
            true_lateral_um,
        };
        Some((exposure, info))
    }
}
