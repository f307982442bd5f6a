//! Every number that decides a verdict, with its reason and the test that pins it.

/// Price of a free number in twice the log-likelihood: the information that narrows its value from its whole range to a few
/// percent of the range.
pub(crate) const NUMBER: f64 = 8.0;

/// Probability by which chance makes one false step in a whole search.
pub(crate) const CHANCE: f64 = 0.05;

/// An excess beyond this number of standard deviations is not due to chance: [`CHANCE`] over [`Thresholds::trials`], in the upper
/// tail of a normal distribution. Cells of the map and numbers of a set are fewer than the trials. That margin covers the last
/// percent by which floor (a walk and white noise) and equations differ from nature. Pinned by
/// `records_that_hide_nothing_get_no_name`.
pub(crate) const CHANCE_SD: f64 = 4.056;

/// The numbers that decide. There is one set, [`THRESHOLDS`]; they are fields so that each has its reason next to it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thresholds {
    /// Factor, for the error of the noise estimate, on the least gain of an addition in twice the log-likelihood. That gain is the
    /// quantile of chi-square with its degrees of freedom at `CHANCE_SD`. Pinned by `records_that_hide_nothing_get_no_name`.
    pub addition_noise: f64,
    /// Part of an effect's response by which its equation may differ from the rig's, as a standard deviation. About the mean of
    /// `sqrt(1 - closure)` of the second equations of the tests' simulator (`reconcile-table seconds SEED` prints each closure).
    pub form_error: f64,
    /// Rivals closer than this in twice the log-likelihood count as equal to the winner: e^5 to 1. Pinned by
    /// `a_lag_of_the_driver_is_named_with_the_bubble_as_its_alternative`.
    pub tie: f64,
    /// A set that closes less than this part of the excess over the floor is no explanation.
    pub closed_least: f64,
    /// A set that closes less than this leaves a remainder; the verdict names it if the rest is beyond chance.
    pub closed_whole: f64,
    /// An excess beyond this number of standard deviations of its scatter is not due to chance. Pinned with the two above.
    pub left_sd: f64,
    /// The free-run error on data that was not fitted must fall at least by this share, if it is larger than the walk of the
    /// noise. An effect that predicts nothing over seconds is no effect of the response.
    pub free_run_fall: f64,
    /// On held-out records innovations must close this share of their gap. The tests' simulator gave some two hundred true names,
    /// some only twice as large as the smallest detectable effect; none closed less than 0.58. A few rows of jumps look like an
    /// effect that closes 0.02. An outflow that resists with the square of the speed looks like one that closes 0.47.
    pub held_out_least: f64,
    /// Numbers that move by more than this part between parts of the records, beyond their intervals, belong to another
    /// equation. Pinned by `numbers_that_change_with_the_part_of_the_data_are_no_name`.
    pub split_share: f64,
    /// An effect smaller than the smallest that matters is not named unless it explains this part of the excess.
    pub small_share: f64,
    /// A small effect that explains less than this share of the gap may be the difference between the catalogue's equation of a
    /// larger effect and the rig's. It gets no name if freer forms of the larger ones gain as much. Beyond this share, and for two
    /// effects of like size, nobody could say which is the other's form. Pinned by
    /// `a_small_effect_that_another_form_of_the_large_one_explains_is_no_name`.
    pub companion_share: f64,
    /// An effect is larger if it explains this many times as much. Pinned with it.
    pub companion_times: f64,
    /// Next to a real companion, freer forms of the large effects gain less than this share of the companion's gain. In the tests'
    /// simulator they gained at most 0.05 if the companion was hidden, and at least 0.16 if it was not. Pinned with it.
    pub companion_rest: f64,
    /// If the main number of a companion is outside the range of known rigs, this share is enough: a creep by a power law leaves a
    /// residual like a relaxation of a millisecond.
    pub companion_untypical: f64,
    /// An addition that the search leaves out because of [`Self::form_error`] must gain this many times the usual least gain. Pinned by
    /// `a_small_effect_of_its_own_is_named_beside_a_large_one`.
    pub small_gain: f64,
    /// A hysteresis gets no name if a curve without memory in front of the plant explains this share of what it explains beyond a gain. For
    /// relays that share is 0.4 to 0.8. Pinned by `a_hysteresis_that_any_curve_explains_is_no_name`.
    pub curve_share: f64,
    /// Rows of rest or of repeated command that give the noise to a few percent, and rows in all that can separate effects.
    pub floor_rows: usize,
    /// A command counts as at rest where its range is below this part of the range of all records: a measured input is
    /// never quite still. Pinned by `a_measured_input_rests_and_repeats_within_its_own_noise`.
    pub rest_share: f64,
    /// A command repeats if its difference from one period to the next has an RMS below this share of the command's. It must not
    /// grow from period to period, as the difference of a swelling sine does: then it is the noise of a measured input. Pinned by
    /// `a_measured_input_rests_and_repeats_within_its_own_noise`.
    pub repeat_share: f64,
    /// A stated noise is believed only where the records do not fall below it by more than this part.
    pub stated_excess: f64,
    /// Trials of the search by which a probability is multiplied: variants, starts, pixel sizes. Pinned with `addition_noise`.
    pub trials: f64,
    /// Price, in twice the log-likelihood, of a main parameter outside the range that rigs show: decides ties between names.
    pub untypical: f64,
    /// The same, as a share of the residual of a fit: if a fit is wrong elsewhere, its last percent decides little.
    pub untypical_share: f64,
    /// The model's localisation noise is believed for this rig if the walk differs from the model's by at most this share. The
    /// radius of a bead and the viscosity in a warm room explain such a difference. Pinned with it.
    pub walk_alike: f64,
    /// A fit that leaves more than this per row is rough: what rivals differ by in their last percent decides nothing.
    pub rough: f64,
    /// A single row is a jump beyond this number of standard deviations. Pinned by
    /// `jumps_of_the_bead_are_named_with_rate_and_size_alone_and_beside_another_effect`.
    pub jump_sd: f64,
    /// Least gain in twice the log-likelihood of a term in a formula of the residual.
    pub term_worth: f64,
    /// Least gain that counts as a remainder: of some forty terms, each at chi-square with one number, 25 is beyond chance. The
    /// rest allows for noise that is not quite a walk and white noise.
    pub term_least: f64,
    /// The same as a share of the set's gain, because no equation is exactly nature's. It also bounds the gain of a split that has
    /// separate numbers.
    pub term_share: f64,
    /// With a remainder a set of a search that ended with its budget must close so much: else it may be a compromise between others.
    pub cut_closed: f64,
    /// With a remainder a set must close so much at least for its names to stand.
    pub remainder_closed: f64,
    /// Most by which the scatter of a number between the records widens its interval: a single record may end in another valley.
    pub birge_most: f64,
    /// Shortest total length of records with a changing command, of a rig whose noise is a walk \[s\].
    /// Pinned by `wrong_units_constant_inputs_short_and_foreign_records_get_a_message`, as is the next.
    pub needed_s: f64,
    /// The same for records of other plants, which may be sampled slowly. Records with fewer rows than a floor needs end without a
    /// name; the verdict then says only how the residual looks.
    pub needed_rows_of_others: usize,
    /// Below this part of the motion a record does not go with the model in any sense.
    pub least_alike: f64,
    /// Fewest gaps or repeated frames that are a fault of the camera: fewer are a start-up glitch or a stall. Pinned by the counts of
    /// the labelled cases, as are the others of frames.
    pub faults_least: usize,
    /// Smallest rate of missing or repeated frames that is reported.
    pub faults_rate: f64,
    /// Excess of repeats over those by chance, in standard deviations of the chance repeats.
    pub repeats_sd: f64,
    /// The same as a share of the chance repeats.
    pub repeats_share: f64,
    /// Rows that repeat more often than this are no camera's: a sensor that counts, or rows that were held.
    pub repeats_most: f64,
    /// Repeats of which more than this part follow each other at one distance are rows that were held.
    /// Pinned by `frames_that_come_thrice_are_a_fault_and_rows_held_in_a_rhythm_or_for_long_are_none`.
    pub repeats_rhythm: f64,
}

/// The numbers in use.
pub const THRESHOLDS: Thresholds = Thresholds {
    addition_noise: 1.3,
    form_error: 0.06,
    tie: 10.0,
    closed_least: 0.80,
    closed_whole: 0.985,
    left_sd: 5.0,
    free_run_fall: 0.2,
    held_out_least: 0.5,
    split_share: 0.15,
    small_share: 0.5,
    companion_share: 0.1,
    companion_times: 3.0,
    companion_rest: 0.1,
    companion_untypical: 0.5,
    small_gain: 4.0,
    curve_share: 0.95,
    floor_rows: 400,
    rest_share: 1e-3,
    repeat_share: 0.14,
    stated_excess: 0.1,
    trials: 2000.0,
    untypical: 12.0,
    untypical_share: 0.2,
    walk_alike: 0.3,
    rough: 0.02,
    jump_sd: 6.0,
    term_worth: 40.0,
    term_least: 80.0,
    term_share: 0.01,
    cut_closed: 0.999,
    remainder_closed: 0.9,
    birge_most: 5.0,
    needed_s: 5.0,
    needed_rows_of_others: 150,
    least_alike: 0.08,
    faults_least: 5,
    faults_rate: 2e-4,
    repeats_sd: 5.0,
    repeats_share: 0.5,
    repeats_most: 0.25,
    repeats_rhythm: 0.5,
};
