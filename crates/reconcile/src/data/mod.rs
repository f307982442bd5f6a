//! Records as they come: rows, missing and repeated frames, the noise that they show.

pub(crate) mod actuator;
mod cleaned;
pub(crate) mod coloured;
pub(crate) mod estimate;
pub(crate) mod feedback;
pub(crate) mod floor;
pub(crate) mod flow_estimate;
pub(crate) mod flow_loss;
pub(crate) mod frames;
pub(crate) mod free;
mod loss_filter;
pub(crate) mod motion;
pub(crate) mod no_response;
pub(crate) mod noise;
pub(crate) mod record;
pub(crate) mod repeats;
mod resolution;
pub(crate) mod row_noise;
pub(crate) mod uncertain;
pub(crate) mod waits;
pub(crate) mod whitener;
pub(crate) mod zero_flow;
