//! Every number that decides a verdict, with its reason and the test that pins it.

/// Price of a free number in twice the log-likelihood: what its value takes to be told from its range, to a few percent of it.
pub(crate) const NUMBER: f64 = 8.0;

/// Probability by which chance makes one false step in a whole search.
pub(crate) const CHANCE: f64 = 0.05;

/// What is beyond so many standard deviations is no chance: [`CHANCE`] over [`Thresholds::trials`], in the upper tail of a normal
/// distribution. Cells of the map and numbers of a set are fewer, by as much as the shape of a floor (a walk and white noise) and of an
/// equation is not that of nature to the last percent. Pinned by `records_that_hide_nothing_get_no_name`.
pub(crate) const CHANCE_SD: f64 = 4.056;

/// The numbers that decide. There is one set, [`THRESHOLDS`]; they are fields so that each has its reason beside it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thresholds {
    /// Factor, for the error of the noise estimate, on what an addition must gain in twice the log-likelihood: the quantile of chi-square
    /// with its degrees of freedom at `CHANCE_SD`. Pinned by `records_that_hide_nothing_get_no_name`.
    pub addition_noise: f64,
    /// What a response to the command must gain beside others, in parts of what is explained already: the equations of the
    /// first effect are not those of nature to the last digit. Pinned by the tests' simulator (relays for play operators).
    pub addition_share: f64,
    /// Rivals closer than this in twice the log-likelihood cannot be told from the winner: e^5 to 1.
    /// Pinned by `a_lag_of_the_driver_is_named_with_the_bubble_as_its_alternative`.
    pub tie: f64,
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
    /// On held-out records innovations must close this part of their gap: of some two hundred true names of the tests' simulator, twice what
    /// can be detected at all among them, none closed less than 0.58; a few rows of jumps look like an
    /// effect that closes 0.02, an outflow that resists with the square of the speed like one that closes 0.47.
    pub held_out_least: f64,
    /// Numbers that move by more than this part between parts of the records, beyond their intervals, belong to another
    /// equation. Pinned by `numbers_that_change_with_the_part_of_the_data_are_no_name`.
    pub split_share: f64,
    /// An effect smaller than the smallest that matters is not named unless it explains this part of the excess.
    pub small_share: f64,
    /// An effect beside larger ones that explains less than this part of the gap may be the difference between the catalogue's
    /// equation of these and the rig's: it is no name where their freer forms gain as much. Beyond it, and of two of like size,
    /// nobody would say which is the other's form. Pinned by `a_small_effect_that_another_form_of_the_large_one_explains_is_no_name`.
    pub companion_share: f64,
    /// Larger is what explains so many times as much. Pinned with it.
    pub companion_times: f64,
    /// Beside a companion that is real, freer forms of the large ones gain less than this part of what it gains: in the tests' simulator
    /// 0.05 at most where it was hidden, 0.16 at least where it was not. Pinned with it.
    pub companion_rest: f64,
    /// Of a companion whose main number lies outside the range that rigs show, freer forms need gain this part only: a creep by a power
    /// law leaves what looks like a relaxation of a millisecond.
    pub companion_untypical: f64,
    /// What is smaller beside the others than [`Self::addition_share`] must gain so many times what any addition must.
    /// Pinned by `a_small_effect_of_its_own_is_named_beside_a_large_one`.
    pub small_gain: f64,
    /// A hysteresis of which a curve without memory in front of the plant explains this part is none: of relays it explains 0.4 to
    /// 0.8. Pinned by `a_hysteresis_that_any_curve_explains_is_no_name`.
    pub curve_share: f64,
    /// Rows of rest or of repeated command from which noise is known to a few percent, and rows in all from which effects can be told apart.
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
    /// Trials of the search by which a probability is multiplied: variants, starts, pixel sizes. Pinned with `addition_noise`.
    pub trials: f64,
    /// How far a line must stand above its neighbours, in power. Pinned by `leak_and_hum_together_are_both_named` and, from the other
    /// side, by `records_that_hide_nothing_get_no_name`.
    pub line_above: f64,
    /// Price, in twice the log-likelihood, of a main parameter outside the range that rigs show: decides ties between names.
    pub untypical: f64,
    /// The same, in parts of what a fit leaves over: one that is wrong elsewhere decides little by its last percent.
    pub untypical_share: f64,
    /// A walk may differ from the model's by this part for the model's localisation noise to be believed of this rig: the
    /// radius of a bead and the viscosity of a warm room make so much. Pinned with it.
    pub walk_alike: f64,
    /// A fit that leaves more than this per row is rough: what rivals differ by in their last percent decides nothing.
    pub rough: f64,
    /// A single row is a jump beyond so many standard deviations. Pinned by `jumps_of_the_bead_are_unknown_and_it_says_where`.
    pub jump_sd: f64,
    /// What a term must gain in twice the log-likelihood to be taken into a formula of what is left.
    pub term_worth: f64,
    /// What it must gain to count as left over: some forty terms, each at chi-square with one number, are beyond chance at 25;
    /// the rest is for a noise whose shape is not quite a walk and white noise.
    pub term_least: f64,
    /// And in parts of what the set gains, for no equation is nature's to the last digit: what a split may gain by numbers of its own, too.
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
    /// The same of records of other plants, which may be sampled slowly: fewer rows than a floor needs end without a name, and
    /// with what the rest looks like.
    pub needed_rows_of_others: usize,
    /// Below this part of the motion a record does not go with the model in any sense.
    pub least_alike: f64,
    /// Fewest missing or repeated frames that are a fault of the camera: fewer are a start-up glitch. Pinned by the counts of
    /// the labelled cases, as are the others of frames.
    pub faults_least: usize,
    /// Smallest rate of missing or repeated frames that is told.
    pub faults_rate: f64,
    /// Repeats beyond those by chance, in standard deviations of these.
    pub repeats_sd: f64,
    /// And in parts of them.
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
    addition_share: 0.0015,
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
    line_above: 10.0,
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
