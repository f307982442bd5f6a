//! Board and world joined on one clock: bytes of the host in, bytes of the board and camera frames out.
//!
//! The caller advances the box to given times; in between the box acts at its own exact instants. A moving output of the board
//! steps every update period, and the world holds it from step to step. So the same code serves the virtual clock, bit by bit
//! deterministic, and the real one. Not a driver: ports, sockets and sleeping are the caller's.

use crate::board_config::{BoardConfig, BoardConfigError};
use crate::config::WorldConfig;
use crate::error::WorldError;
use crate::faults::FaultKind;
use crate::partner::{PressureConfig, PressurePartner};
use crate::world::World;
use cellpos_board::Board;
use cellpos_link::um_from_picometres;
use cellpos_numeric::Random;
use cellpos_plant::Model;

/// The reason why such a box cannot be built.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BoxError {
    /// The board cannot be.
    #[error(transparent)]
    Board(#[from] BoardConfigError),
    /// The world cannot be.
    #[error(transparent)]
    World(#[from] WorldError),
}

/// Longest burst of random bytes on the line.
const GARBAGE_LEN: usize = 24;

/// The board, the rig behind it, and the camera. Times are nanoseconds of the caller's clock.
#[derive(Debug, Clone)]
pub struct RigInABox {
    board: Board,
    world: World,
    start_ns: i64,
    applied_um: f64,
    garbage: Random,
    next_garbage_ns: Option<i64>,
    /// Random bytes on the way to the host.
    noise: [u8; GARBAGE_LEN],
    noise_len: usize,
}

impl RigInABox {
    /// A board that was just switched on, with its world, at `start_ns`.
    ///
    /// # Errors
    /// [`BoxError`] names the invalid value.
    pub fn new(
        board: BoardConfig,
        world: &WorldConfig,
        model: &Model,
        start_ns: i64,
    ) -> Result<Self, BoxError> {
        let board = board.board()?;
        let mut this = Self {
            applied_um: um_from_picometres(board.applied_pm()),
            board,
            world: World::new(world, model, start_ns)?,
            start_ns,
            garbage: Random::stream(world.seed, 30),
            next_garbage_ns: None,
            noise: [0; GARBAGE_LEN],
            noise_len: 0,
        };
        this.next_garbage_ns = this.garbage_after(start_ns);
        Ok(this)
    }

    /// The same with a slow partner of the PZT.
    ///
    /// # Errors
    /// The board of the partner is invalid.
    pub fn with_partner(mut self, config: &PressureConfig) -> Result<Self, BoxError> {
        self.world.partner = Some(PressurePartner::new(config)?);
        Ok(self)
    }

    /// The board.
    pub fn board(&self) -> &Board {
        &self.board
    }

    /// The world: the truth, and the camera's future frames.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// The world, to take frames or positions from.
    pub fn world_mut(&mut self) -> &mut World {
        &mut self.world
    }

    /// Displacement at the board's converter, um.
    pub fn applied_um(&self) -> f64 {
        self.applied_um
    }

    /// Time up to which the box has been advanced, ns.
    pub fn now_ns(&self) -> i64 {
        self.world.now_ns()
    }

    /// Time of the box's next visible action, ns: a step of the output, a watchdog, a status, a delivery of an exposed frame.
    pub fn next_event_ns(&self) -> i64 {
        let board_ns = self.ns_from_us(self.board.next_event_us());
        let delivery_ns = self.world.next_delivery_ns().unwrap_or(i64::MAX);
        board_ns.min(delivery_ns)
    }

    /// Advances to `t_ns`; does nothing for a past time.
    pub fn advance_to(&mut self, t_ns: i64) {
        loop {
            let partner_us = (self.world.partner.as_mut()).map(|p| p.board.next_event_us());
            let partner_ns = partner_us.map_or(i64::MAX, |us| self.ns_from_us(us));
            let board_ns = (self.ns_from_us(self.board.next_event_us())).min(partner_ns);
            let garbage_ns = self.next_garbage_ns.unwrap_or(i64::MAX);
            let event_ns = board_ns.min(garbage_ns);
            if event_ns > t_ns {
                break;
            }
            self.world.advance_to(event_ns, self.applied_um);
            if garbage_ns <= board_ns {
                self.garbage_burst(event_ns);
            }
            self.tick();
        }
        self.world.advance_to(t_ns, self.applied_um);
    }

    /// Bytes of the host that arrive at the board at `t_ns`: they act from that instant on.
    pub fn receive(&mut self, bytes: &[u8], t_ns: i64) {
        self.advance_to(t_ns);
        if self.link_is_cut() {
            return;
        }
        let now_us = self.now_us();
        self.board.receive(bytes, now_us);
        self.tick();
    }

    /// Bytes of the host that arrive at the partner at `t_ns`.
    pub fn receive_partner(&mut self, bytes: &[u8], t_ns: i64) {
        self.advance_to(t_ns);
        let (cut, now_us) = (self.partner_is_cut(), self.now_us());
        if let Some(partner) = self.world.partner.as_mut().filter(|_| !cut) {
            partner.board.receive(bytes, now_us);
            partner.tick(now_us);
        }
    }

    /// Moves bytes of the partner for the host into `out`; returns how many.
    pub fn transmit_partner(&mut self, out: &mut [u8]) -> usize {
        let cut = self.partner_is_cut();
        let sent = (self.world.partner.as_mut()).map_or(0, |partner| partner.board.transmit(out));
        if cut { 0 } else { sent }
    }

    fn partner_is_cut(&self) -> bool {
        let faults = &self.world.config().faults;
        faults.active(FaultKind::PartnerLoss, self.now_ns() - self.start_ns)
    }

    /// Moves bytes for the host into `out`; returns how many.
    pub fn transmit(&mut self, out: &mut [u8]) -> usize {
        let count = self.noise_len.min(out.len());
        if let (Some(to), Some(from)) = (out.get_mut(..count), self.noise.get(..count)) {
            to.copy_from_slice(from);
        }
        self.noise_len = 0;
        let sent = match out.get_mut(count..) {
            Some(rest) => count + self.board.transmit(rest),
            None => count,
        };
        if self.link_is_cut() { 0 } else { sent }
    }

    fn link_is_cut(&self) -> bool {
        let faults = &self.world.config().faults;
        faults.active(FaultKind::LinkLoss, self.now_ns() - self.start_ns)
    }

    fn tick(&mut self) {
        self.board.tick(self.now_us());
        self.applied_um = um_from_picometres(self.board.applied_pm());
        self.world.set_led(self.board.led());
        let now_us = self.now_us();
        if let Some(partner) = self.world.partner.as_mut() {
            partner.tick(now_us);
        }
    }

    fn now_us(&self) -> u64 {
        u64::try_from((self.now_ns() - self.start_ns) / 1000).unwrap_or(0)
    }

    fn ns_from_us(&self, us: u64) -> i64 {
        i64::try_from(us)
            .unwrap_or(i64::MAX)
            .saturating_mul(1000)
            .saturating_add(self.start_ns)
    }

    /// Time of the next burst after `now_ns`.
    fn garbage_after(&mut self, now_ns: i64) -> Option<i64> {
        const MS_NS: i64 = 1_000_000;
        let faults = &self.world.config().faults;
        let elapsed_ns = now_ns - self.start_ns;
        let scheduled = if faults.active(FaultKind::LinkGarbage, elapsed_ns + MS_NS) {
            Some(now_ns + MS_NS)
        } else {
            // The next span to begin, if any.
            faults
                .event
                .iter()
                .filter(|event| event.kind == FaultKind::LinkGarbage)
                .map(|event| self.start_ns.saturating_add((event.at_s * 1e9) as i64))
                .filter(|&at_ns| at_ns > now_ns)
                .min()
        };
        let rate = faults.garbage_per_s;
        let random = (rate > 0.0).then(|| {
            let wait_s = -(1.0 - self.garbage.uniform()).ln() / rate;
            now_ns + ((wait_s * 1e9) as i64).max(1)
        });
        [scheduled, random].into_iter().flatten().min()
    }

    fn garbage_burst(&mut self, now_ns: i64) {
        let mut bytes = [0; GARBAGE_LEN];
        for direction in 0..2 {
            let length = 1 + (self.garbage.uniform() * GARBAGE_LEN as f64) as usize;
            for byte in &mut bytes {
                *byte = (self.garbage.uniform() * 256.0) as u8;
            }
            if direction == 0 {
                let now_us = self.now_us();
                self.board
                    .receive(bytes.get(..length).unwrap_or(&[]), now_us);
            } else {
                self.noise = bytes;
                self.noise_len = length.min(GARBAGE_LEN);
            }
        }
        self.next_garbage_ns = self.garbage_after(now_ns);
    }
}
