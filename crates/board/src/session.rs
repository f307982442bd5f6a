//! State of one session: limits, watchdog times, and the test whether a command is new.

use crate::Config;
use cellpos_link::{Arm, Command, Limits, Order, Refusal, order};

/// Set by arming, and reset by every arming.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Session {
    pub(crate) number: u16,
    pub(crate) limits: Limits,
    pub(crate) park_pm: i32,
    pub(crate) watchdog_us: u64,
    pub(crate) hold_watchdog_us: u64,
    pub(crate) interpolate: bool,
    pub(crate) status_every: u16,
    pub(crate) since_status: u16,
    pub(crate) last_seq: Option<u32>,
    pub(crate) last_time_us: u64,
    pub(crate) last_command_us: u64,
    pub(crate) neutral_pm: Option<i32>,
    /// Number of moves to the zero-flow displacement because commands stopped.
    pub(crate) holds: u16,
    /// Smallest transit time so far, ns, and its time (us): the reference for longer ones.
    fastest: Option<(i64, u64)>,
}

impl Session {
    /// The values before the first arming.
    pub(crate) fn before_any(config: &Config) -> Self {
        Self {
            number: 0,
            limits: config.limits,
            park_pm: config.park_pm,
            watchdog_us: u64::from(config.watchdog_ms) * 1000,
            hold_watchdog_us: u64::from(config.hold_watchdog_ms) * 1000,
            interpolate: false,
            status_every: 1,
            since_status: 0,
            last_seq: None,
            last_time_us: 0,
            last_command_us: 0,
            neutral_pm: None,
            holds: 0,
            fastest: None,
        }
    }

    /// The session that a host requests, if it is within the board's limits.
    pub(crate) fn asked(arm: &Arm, config: &Config, now_us: u64) -> Result<Self, Refusal> {
        let own = config.limits;
        let inside = |pm: i32| pm >= own.low_pm && pm <= own.high_pm;
        let limits = arm.limits.unwrap_or(own);
        if limits.low_pm >= limits.high_pm
            || !inside(limits.low_pm)
            || !inside(limits.high_pm)
            || limits.slew_nm_per_s == 0
            || limits.slew_nm_per_s > own.slew_nm_per_s
        {
            return Err(Refusal::Limits);
        }
        // Park may lie outside the tighter limits of a session: a ramp to park ends the session.
        let park_pm = arm.park_pm.unwrap_or(config.park_pm);
        if !inside(park_pm) {
            return Err(Refusal::Park);
        }
        let watchdog_ms = arm.watchdog_ms.unwrap_or(config.watchdog_ms);
        let hold_watchdog_ms = arm.hold_watchdog_ms.unwrap_or(config.hold_watchdog_ms);
        let allowed = 1..=config.longest_watchdog_ms;
        if !allowed.contains(&watchdog_ms) || !allowed.contains(&hold_watchdog_ms) {
            return Err(Refusal::Watchdog);
        }
        Ok(Self {
            number: arm.session,
            limits,
            park_pm,
            watchdog_us: u64::from(watchdog_ms) * 1000,
            hold_watchdog_us: u64::from(hold_watchdog_ms) * 1000,
            interpolate: arm.interpolate,
            status_every: arm.status_every,
            last_command_us: now_us,
            ..Self::before_any(config)
        })
    }

    /// A displacement within the session's range.
    pub(crate) fn within(&self, pm: i32) -> i32 {
        pm.max(self.limits.low_pm).min(self.limits.high_pm)
    }

    /// Whether a command is of this session and newer than the last.
    pub(crate) fn is_fresh(&self, command: &Command) -> bool {
        command.session == self.number
            && self
                .last_seq
                .is_none_or(|last| matches!(order(last, command.seq), Order::Newer { .. }))
    }

    /// Whether a command took `late_us` longer on its way than the fastest one.
    ///
    /// The two clocks have no common zero, so only differences count. Two crystals differ by at most 200 ppm, so the fastest
    /// transit time may grow by that share of the elapsed time.
    pub(crate) fn is_late(&mut self, command: &Command, now_us: u64, late_us: u32) -> bool {
        let transit_us = (now_us as i64).wrapping_sub(command.time_us as i64);
        let transit_ns = transit_us.saturating_mul(1000);
        let floor_ns = self.fastest.map_or(transit_ns, |(fastest_ns, at_us)| {
            fastest_ns.saturating_add_unsigned(now_us.saturating_sub(at_us) / 5)
        });
        self.fastest = Some((transit_ns.min(floor_ns), now_us));
        transit_ns > floor_ns.saturating_add(i64::from(late_us) * 1000)
    }

    /// Counts a command; returns whether a status is due after it.
    pub(crate) fn status_is_due(&mut self) -> bool {
        self.since_status = self.since_status.saturating_add(1);
        self.status_every > 0 && self.since_status >= self.status_every
    }
}
