//! Every number that decides a verdict, with its reason and the test that pins it.

/// The numbers that decide. There is one set, [`THRESHOLDS`]; they are fields so that each has its reason beside it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thresholds {
    /// What an addition must gain in twice the log-likelihood: this quantile of chi-square with its degrees of freedom, in
    /// standard deviations. 4.1 is 5 % together over some 2000 trials (variants, starts, pixel sizes).
    /// Pinned by `records_that_hide_nothing_get_no_name`.
    pub addition_sd: f64,
    /// Factor on that for the error of the noise estimate. Pinned with it.
    pub addition_noise: f64,
    /// What a response to the command must gain beside others, in parts of what is explained already: the equations of the
    /// first effect are not those of nature to the last digit. Pinned by the tests' simulator (relays for play operators).
    pub addition_share: f64,
    /// Rivals closer than this in twice the log-likelihood cannot be told from the winner: e^5 to 1.
    /// Pinned by `a_lag_of_the_driver_is_named_with_the_bubble_as_its_alternative`.
    pub tie: f64,
    /// A valley no deeper than this below the best belongs to the 95 % interval (chi-square, one number).
    pub valley: f64,
    /// A set that closes less than this part of the excess over the floor is no explanation.
    /// Pinned by `jumps_of_the_bead_are_unknown_and_it_says_where`.
    pub closed_least: f64,
    /// A set that closes less than this leaves a remainder that is said, where what is left is beyond chance.
    pub closed_whole: f64,
    /// An excess beyond so many standard deviations of its own scatter is no chance. Pinned with the two above.
    pub left_sd: f64,
    /// By this part at least the free-run error must fall on data that was not fitted, where it is beyond what the walk of
    /// the noise makes: an effect that predicts nothing over seconds is no effect of the response.
    pub free_run_fall: f64,
    /// After two effects, a set that leaves more than this part of the excess is on no way to an explanation: the search ends
    /// there, and the verdict will be `unknown`. Saves minutes, decides nothing that [`Self::closed_least`] does not.
    pub hopeless: f64,
    /// Numbers that move by more than this part between parts of the records, beyond their intervals, belong to another
    /// equation. Pinned by `numbers_that_change_with_the_part_of_the_data_are_no_name`.
    pub split_share: f64,
    /// What a split may gain by numbers of its own, in parts of what the set gains, before the numbers are looked at.
    pub split_gain: f64,
    /// An effect smaller than the smallest that matters is not named unless it explains this part of the excess.
    pub small_share: f64,
    /// Rows of rest or of repeated command from which noise is known to a few percent.
    pub floor_rows: usize,
    /// A command counts as at rest where its range is below this part of the range of all records: a measured input is
    /// never quite still. Pinned by `a_measured_input_rests_and_repeats_within_its_own_noise`.
    pub rest_share: f64,
    /// A command repeats where its difference from one period to the next has an RMS below this part of its own, and does
    /// not grow from period to period as that of a swelling sine does: the noise of a measured input.
    /// Pinned by `a_measured_input_rests_and_repeats_within_its_own_noise`.
    pub repeat_share: f64,
    /// A stated noise is believed only where the records do not fall below it by more than this part.
    pub stated_excess: f64,
}

/// The numbers in use.
pub const THRESHOLDS: Thresholds = Thresholds {
    addition_sd: 4.1,
    addition_noise: 1.3,
    addition_share: 0.0015,
    tie: 10.0,
    valley: 3.84,
    closed_least: 0.80,
    closed_whole: 0.985,
    left_sd: 5.0,
    free_run_fall: 0.2,
    hopeless: 0.6,
    split_share: 0.15,
    split_gain: 0.01,
    small_share: 0.5,
    floor_rows: 400,
    rest_share: 1e-3,
    repeat_share: 0.14,
    stated_excess: 0.1,
};
