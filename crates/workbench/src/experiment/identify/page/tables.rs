//! The tables of an identification: parameters, lines, candidate orders.

use cellpos_ident::identifiability::{Identifiability, IdentifiedParameter};
use cellpos_ident::summary::Identification;
use cellpos_numeric::statistics::Z95;
use cellpos_plant::{Hertz, TransferFunction};
use cellpos_report::{Column, Emphasis, Table, number};

pub(super) fn interval(ends: [f64; 2]) -> String {
    format!("{} .. {}", number(ends[0]), number(ends[1]))
}

/// The table of parameters with verdicts.
pub fn parameters(parameters: &[IdentifiedParameter]) -> Table {
    let mut table = Table::new([
        Column::left("parameter"),
        Column::right("value"),
        Column::left("unit"),
        Column::right("95 % interval"),
        Column::right("by bootstrap"),
        Column::left("verdict"),
    ]);
    for p in parameters {
        let (status, verdict) = match &p.verdict {
            Identifiability::Identified => (Emphasis::Good, "identified".to_owned()),
            Identifiability::NotIdentifiable { reason } => (
                Emphasis::Warning,
                format!("not identifiable from this band: {reason}"),
            ),
        };
        table.row_with(
            status,
            [
                format!("{} ({})", p.name, p.meaning),
                number(p.value),
                p.unit.to_owned(),
                interval(p.ci95),
                p.bootstrap95.map(interval).unwrap_or_default(),
                verdict,
            ],
        );
    }
    table
}

/// The table of frequencies, with Eq. (6) on request.
pub fn lines(result: &Identification, eq6: bool) -> Table {
    let nominal = TransferFunction::eq6();
    let heads = [
        ("Hz", false),
        ("gain dB", false),
        ("+-95 %", false),
        ("Eq. (6) dB", true),
        ("phase deg", false),
        ("+-95 %", false),
        ("Eq. (6) deg", true),
        ("with delay deg", false),
        ("in the record deg", false),
        ("coherence", false),
    ];
    let shown = |of_eq6: bool| eq6 || !of_eq6;
    let columns = heads.iter().filter(|(_, of_eq6)| shown(*of_eq6));
    let mut table = Table::with_columns(columns.map(|(name, _)| Column::right(name)).collect());
    for p in &result.compensated {
        let cells = [
            format!("{}", p.frequency_hz),
            format!("{:.3}", p.gain_db),
            format!("{:.3}", Z95 * p.gain_sd_db),
            format!("{:.2}", nominal.gain_db(Hertz(p.frequency_hz)).0),
            format!("{:.2}", p.phase_deg),
            format!("{:.2}", Z95 * p.phase_sd_deg),
            format!("{:.2}", nominal.phase_deg(Hertz(p.frequency_hz)).0),
            format!("{:.1}", p.delayed_phase_deg),
            format!("{:.1}", p.raw_phase_deg),
            format!("{:.5}", p.coherence),
        ];
        let cells = cells.into_iter().zip(heads);
        table.row(
            cells
                .filter(|(_, (_, of_eq6))| shown(*of_eq6))
                .map(|(cell, _)| cell),
        );
    }
    table
}

/// The table of candidate orders.
pub fn candidates(result: &Identification) -> Table {
    let mut table = Table::new([
        Column::left("model"),
        Column::right("chi2"),
        Column::right("dof"),
        Column::right("AICc"),
        Column::right("held out, per datum"),
        Column::right("p of this step"),
    ]);
    for (i, r) in result.selection.candidates.iter().enumerate() {
        table.row_with(
            if i == result.selection.chosen {
                Emphasis::Good
            } else {
                Emphasis::Plain
            },
            [
                r.order.formula().to_owned(),
                format!("{:.1}", r.chi2),
                format!("{:.0}", r.dof),
                format!("{:.1}", r.aicc),
                format!("{:.3}", r.held_out),
                format!("{:.1e}", r.step_p_value),
            ],
        );
    }
    table
}
