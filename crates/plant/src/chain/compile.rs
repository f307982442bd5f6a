//! From a model to the sequence of stages that a [`super::Chain`] advances.

use super::linear::LinearGroup;
use super::tied::TiedPlant;
use crate::effects::{Action, Around, Block, Place};
use crate::modal::Zpk;
use crate::model::Model;

/// A stage of the chain.
#[derive(Debug, Clone)]
pub(crate) enum Stage {
    Linear(LinearGroup),
    Block(Box<dyn Block>),
    Tied(Box<TiedPlant>),
}

/// The compiled chain without the state of its front end (saturation, slew).
#[derive(Debug, Clone)]
pub(crate) struct Compiled {
    pub stages: Vec<Stage>,
    /// Index of the group that holds the plant and the tap of the PZT displacement.
    pub plant: usize,
    /// Other paths from the input of that group to the record, parallel to the plant.
    pub bypass: Vec<LinearGroup>,
    /// Displacements from the working point, um.
    pub low: f64,
    pub high: f64,
    /// um/s; infinite without a slew limit.
    pub rate: f64,
    /// Longest piece, s; infinite when every stage is exact.
    pub substep_s: f64,
    /// Whether a stage needs slopes and integrals of its input.
    pub needs_slopes: bool,
}

/// Collects, stage by stage, everything between the command and the bead.
struct Builder {
    stages: Vec<Stage>,
    /// The linear blocks since the last stage.
    pending: Zpk,
    /// The pending blocks up to the end of the PZT; set once the chain has passed that place.
    tap: Option<Zpk>,
    plant: usize,
    /// Whether the signal so far can change while the command is constant.
    moving: bool,
    fastest: f64,
    substep_s: f64,
    needs_slopes: bool,
}

/// Shortest and longest sub-step, s.
const SHORTEST_S: f64 = 2e-5;
const LONGEST_S: f64 = 2.5e-4;
/// Length of sub-steps, as a part of the fastest time constant before the block that needs them.
const PART_OF_TIME_CONSTANT: f64 = 0.25;

impl Builder {
    fn flush(&mut self) {
        if self.pending == Zpk::one() && self.tap.is_none() {
            return;
        }
        let whole = std::mem::replace(&mut self.pending, Zpk::one());
        let tap = self.tap.take();
        if tap.is_some() {
            self.plant = self.stages.len();
        }
        let group = LinearGroup::new(whole, tap.as_ref());
        self.fastest = self.fastest.max(group.fastest());
        self.moving |= group.fastest() > 0.0;
        self.stages.push(Stage::Linear(group));
    }

    fn push(&mut self, block: Box<dyn Block>) {
        self.flush();
        self.needs_slopes |= block.needs_slopes();
        if let Some(longest_s) = block.longest_s() {
            self.substep_s = self.substep_s.min(longest_s.max(SHORTEST_S));
        }
        if block.bends() && self.moving {
            let wanted = PART_OF_TIME_CONSTANT / self.fastest.max(1.0);
            self.substep_s = self.substep_s.min(wanted.clamp(SHORTEST_S, LONGEST_S));
        }
        self.stages.push(Stage::Block(block));
    }

    /// The plant with its tied effects is one stage; the path to it is another, with the PZT's displacement as output.
    fn tied_plant(&mut self, plant: &Zpk, ties: Vec<Box<dyn Around>>) {
        self.tap = Some(self.pending.clone());
        self.flush();
        let tied = TiedPlant::new(plant, ties);
        self.substep_s = self.substep_s.min(tied.longest_s());
        self.fastest = self.fastest.max(0.2 / tied.longest_s());
        self.moving = true;
        self.stages.push(Stage::Tied(Box::new(tied)));
    }

    /// The plant joins the linear blocks gathered so far; their end is the PZT's displacement.
    fn plant(&mut self, plant: &Zpk) {
        self.tap = Some(self.pending.clone());
        self.pending = std::mem::replace(&mut self.pending, Zpk::one()).series(plant);
    }
}

pub(crate) fn compile(model: &Model) -> Compiled {
    let mut builder = Builder {
        stages: Vec::new(),
        pending: Zpk::one(),
        tap: None,
        plant: 0,
        moving: false,
        fastest: 0.0,
        substep_s: f64::INFINITY,
        needs_slopes: false,
    };
    let (mut low, mut high, mut rate) = (f64::NEG_INFINITY, f64::INFINITY, f64::INFINITY);
    let plant = Zpk::of(&model.plant);
    let mut plant_is_in = false;
    // The path from the PZT to the record parallel to the plant, and the linear blocks before it.
    let mut beside: Vec<Zpk> = Vec::new();
    let mut before_plant = Zpk::one();
    let effects = model.ordered_effects();
    let mut ties: Vec<Box<dyn Around>> = Vec::new();
    for effect in &effects {
        if let Action::Around(tie) = effect.act() {
            ties.push(tie);
        }
    }
    let mut put_in = |builder: &mut Builder| match std::mem::take(&mut ties) {
        none if none.is_empty() => builder.plant(&plant),
        ties => builder.tied_plant(&plant, ties),
    };
    let passes_by = |e: &&&crate::effects::Effect| matches!(e.act(), Action::Bypass(_));
    for effect in effects.iter().filter(passes_by) {
        if let Action::Bypass(zpk) = effect.act() {
            beside.push(zpk);
        }
    }
    for effect in effects {
        let spec = effect.kind().spec();
        if spec.place >= Place::Chip && !spec.ahead_of_plant && !plant_is_in {
            before_plant = builder.pending.clone();
            put_in(&mut builder);
            plant_is_in = true;
        }
        match effect.act() {
            Action::Linear(zpk) => {
                builder.pending = std::mem::replace(&mut builder.pending, Zpk::one()).series(&zpk);
            }
            Action::Clip { low_um, high_um } => {
                low = low.max(low_um - model.working_point_um);
                high = high.min(high_um - model.working_point_um);
            }
            Action::Slew(um_per_s) => {
                rate = rate.min(um_per_s);
                builder.moving = true;
            }
            Action::Block(block) => builder.push(block),
            // The camera's effects are in the simulator. Effects tied to the plant are in the plant's stage.
            Action::Around(_)
            | Action::Bypass(_)
            | Action::Delay(_)
            | Action::Exposure(_)
            | Action::Skew(_)
            | Action::Drop(_)
            | Action::Repeat(_)
            | Action::Show(_) => {}
        }
    }
    if !plant_is_in {
        before_plant = builder.pending.clone();
        put_in(&mut builder);
    }
    builder.flush();
    Compiled {
        bypass: beside
            .iter()
            .map(|zpk| LinearGroup::new(before_plant.clone().series(zpk), None))
            .collect(),
        stages: builder.stages,
        plant: builder.plant,
        low,
        high,
        rate,
        substep_s: builder.substep_s,
        needs_slopes: builder.needs_slopes,
    }
}
