//! Does the bead follow the commands, or is the loop itself what drives it away?
//!
//! With a wrong sign, a gain far off or an actuator that does not follow, the error grows while the command pushes ever harder
//! against it. A step of the flow makes the error grow as well, but the harder the command pushes, the slower the bead becomes. So
//! the last 12 and the last 21 ms are looked at in three parts, each longer than the delay: the command pushed in the second part and harder in the
//! third, and the bead went against it by as much more as the push became harder. A flow that rises does not: the push catches up.

/// Time from sample to sample, s.
const BETWEEN_S: f64 = 0.001;
/// Samples in each of the three parts: a large gain drives a bead away within 12 ms, a small one within 21.
const PARTS: [usize; 2] = [4, 7];
/// Samples in all.
const SAMPLES: usize = 22;
/// Commands remembered: their way to a fix takes the camera's delay.
const COMMANDS: usize = 64;
/// By how much the push must have become harder from part to part. A wrong sign makes it grow by more than the half in 7 ms, or
/// nothing is lost yet.
const HARDER: f64 = 1.5;
/// What of the way over the push must be left in the last part. A bead that the push drives away keeps all of it; of a flow that
/// rises at a constant rate the push takes a delay to follow, and the share falls below a half from part to part.
const KEPT_SHARE: f64 = 0.7;
/// What of the push the bead must have gone against it: an actuator that does not move at all leaves the bead to the flow.
const LEAST_SHARE: f64 = 0.5;
/// Growth of the error, and push in a part, below which nothing is concluded, um: five standard deviations of a bead of 1 um that is held.
const LEAST_UM: f64 = 0.25;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Sample {
    position_um: f64,
    error_um: f64,
    /// Command in force then, um.
    command_um: f64,
    zero_flow_um: f64,
}

/// The last 21 ms of a loop that runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Following {
    samples: [Sample; SAMPLES],
    count: usize,
    /// Ticks between samples, and until the next.
    stride: u32,
    until_next: u32,
    /// Way of the bead for a displacement of 1 um over the time between two samples, um.
    gain: f64,
    /// Newest commands first, um, and how many ticks a fix is behind them.
    commands_um: [f64; COMMANDS],
    delay: usize,
    /// The parts are a piezo's: the lags of a slow actuator are longer than they.
    fast: bool,
}

/// What a tick shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seen {
    /// Position of the fix, um.
    pub position_um: f64,
    /// Position less its reference, um.
    pub error_um: f64,
    /// Command of this tick, um; it shows in a fix one delay later.
    pub command_um: f64,
    /// Zero flow as it was believed to be, um.
    pub zero_flow_um: f64,
}

impl Following {
    /// For ticks of `sample_s`, a gain in um/s of bead per um of displacement, and fixes that are `delay_s` old.
    pub fn new(sample_s: f64, gain_per_s: f64, delay_s: f64) -> Self {
        let stride = (BETWEEN_S / sample_s).round().max(1.0);
        let delay = (delay_s / sample_s)
            .round()
            .clamp(0.0, (COMMANDS - 1) as f64);
        Self {
            samples: [Sample::default(); SAMPLES],
            count: 0,
            stride: stride as u32,
            until_next: 0,
            gain: gain_per_s * sample_s * stride,
            commands_um: [0.0; COMMANDS],
            delay: delay as usize,
            fast: sample_s <= 2.0 * BETWEEN_S,
        }
    }

    /// What was seen no longer counts: the loop did not run, or the bead was not seen.
    pub fn clear(&mut self) {
        (self.count, self.until_next) = (0, 0);
    }

    /// Takes in a tick; true when the loop drives the bead away.
    pub fn step(&mut self, seen: Seen) -> bool {
        self.commands_um.copy_within(..COMMANDS - 1, 1);
        self.commands_um[0] = seen.command_um;
        self.until_next = self.until_next.saturating_sub(1);
        if self.until_next > 0 {
            return false;
        }
        self.until_next = self.stride;
        self.samples.copy_within(1.., 0);
        self.samples[SAMPLES - 1] = Sample {
            position_um: seen.position_um,
            error_um: seen.error_um,
            command_um: self
                .commands_um
                .get(self.delay)
                .copied()
                .unwrap_or(seen.command_um),
            zero_flow_um: seen.zero_flow_um,
        };
        self.count = (self.count + 1).min(SAMPLES);
        let longer = |part: &usize| self.fast && *part as u32 * self.stride > self.delay as u32;
        let parts = PARTS.into_iter().filter(longer);
        let (count, this) = (self.count, &*self);
        parts
            .filter(|part| 3 * part < count)
            .any(|part| this.drives_away(part))
    }

    fn drives_away(&self, length: usize) -> bool {
        let from = SAMPLES - 1 - 3 * length;
        let part = |n: usize| {
            let first = from + n * length;
            self.samples.get(first..=first + length).unwrap_or(&[])
        };
        // The zero flow of the beginning: what was learnt since may be what is wrong.
        let rest_um = part(0).first().map_or(f64::NAN, |s| s.zero_flow_um);
        let push_um = |n| -> f64 {
            let ways = part(n).iter().take(length);
            self.gain * ways.map(|s| s.command_um - rest_um).sum::<f64>()
        };
        let went_um = |n| match part(n) {
            [first, .., last] => last.position_um - first.position_um,
            _ => 0.0,
        };
        let error_um = |n| part(n).iter().map(|s| s.error_um).sum::<f64>() / (length + 1) as f64;
        // Seen from the side to which the bead is now.
        let side = error_um(2).signum();
        let against = |n| -side * push_um(n);
        let away = |n| side * went_um(n);
        let grows = side * error_um(2) - side * error_um(1) > LEAST_UM;
        let harder = against(1) > LEAST_UM && against(2) > HARDER * against(1);
        // By the push: as much more as that became harder.
        let driven = away(1) > 0.0 && away(2) * against(1) > KEPT_SHARE * away(1) * against(2);
        grows && harder && driven && away(2) > LEAST_SHARE * against(2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A proportional loop with 2 ms of delay on a plant of `sign` times the gain from 0.1 s on, and a flow that rises to `flow_um`
    /// in `rise` ms then.
    fn run(sign: f64, flow_um: f64, rise: f64) -> Option<usize> {
        let (gain, kp) = (0.38, 0.4);
        let mut following = Following::new(1e-3, 380.0, 2e-3);
        let mut commands = [0.0; 4];
        let (mut bead_um, mut zero_um) = (0.05, 0.0);
        let mut seen_um = [0.0; 3];
        for k in 0..400_i32 {
            // The walk of a bead is what a wrong sign makes grow.
            bead_um += if k == 100 { 0.05 } else { 0.0 };
            let since = (f64::from(k) - 99.0) / rise;
            let (flow, sign) = if k < 100 {
                (0.0, 1.0)
            } else {
                (flow_um * since.min(1.0), sign)
            };
            bead_um += gain * (sign * commands[0] - flow);
            seen_um.rotate_left(1);
            seen_um[2] = bead_um;
            let position_um = seen_um[0];
            zero_um += -0.02 * position_um;
            let command_um = (zero_um - kp * position_um).clamp(-20.0, 20.0);
            commands.rotate_right(1);
            commands[0] = command_um;
            let seen = Seen {
                position_um,
                error_um: position_um,
                command_um,
                zero_flow_um: zero_um,
            };
            if following.step(seen) {
                return Some((k - 100) as usize);
            }
        }
        None
    }

    #[test]
    fn a_flipped_sign_is_told_within_40_ms_and_a_flow_that_rises_never() {
        let told = run(-1.0, 0.0, 1.0);
        assert!(told.is_some_and(|ticks| ticks < 40), "{told:?}");
        for flow_um in [0.1, -0.3, 1.0, -2.6] {
            for rise in [1.0, 3.0, 6.0, 10.0, 20.0, 40.0, 80.0] {
                assert_eq!(run(1.0, flow_um, rise), None, "{flow_um} um in {rise} ms");
            }
        }
    }
}
