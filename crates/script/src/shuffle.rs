//! The random order of a sweep.

/// Fisher and Yates' shuffle with SplitMix64: the same seed gives the same order on every machine.
pub(crate) fn shuffle(values: &mut [String], seed: u64) {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    for last in (1..values.len()).rev() {
        values.swap(last, (next() % (last as u64 + 1)) as usize);
    }
}
