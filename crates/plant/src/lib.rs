//! The plant of Mizoue et al. 2017, Eq. (1)-(7), its discretisation, effect blocks and model files.
#![forbid(unsafe_code)]
