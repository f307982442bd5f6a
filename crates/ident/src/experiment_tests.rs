use super::*;

#[test]
fn a_schedule_is_what_a_run_would_have_added_tick_by_tick() {
    struct Noting(Vec<f64>);
    impl Bench for Noting {
        type Error = std::convert::Infallible;
        fn tick(&mut self, excitation_um: f64) -> Result<Row, Self::Error> {
            self.0.push(excitation_um);
            Ok(Row {
                command_um: excitation_um,
                bead_um: Some(0.0),
            })
        }
    }
    let limits = ExcitationLimits {
        bead_um: 8.0,
        bead_um_per_s: 400.0,
        pzt_um: 10.0,
        slew_um_per_s: 3200.0,
    };
    let integrator = |f: f64| {
        (
            Complex::new(0.0, -400.0 / (2.0 * std::f64::consts::PI * f)),
            Complex::new(0.0, 0.0),
        )
    };
    let plan = Plan::stepped_sines(&[5.0, 20.0, 50.0], &integrator, limits, 1e-3, 10.0);
    let mut noted = Noting(Vec::new());
    let records = plan.run(&mut noted, 1, |_| {}).unwrap();
    let schedule = plan.schedule(&[1, 2].map(Turn::planned));
    assert_eq!(schedule.excitation_um, noted.0);
    for (span, record) in schedule.spans.iter().zip(&records) {
        assert_eq!(
            (span.index, span.settle, span.rows),
            (record.index, record.from, record.input.len())
        );
        assert_eq!(
            schedule.excitation_um[span.start..span.start + span.rows],
            record.input[..]
        );
    }
    let gentler = plan.schedule(&[1, 2].map(|index| Turn { index, part: 0.5 }));
    let halved: Vec<f64> = noted.0.iter().map(|um| 0.5 * um).collect();
    assert_eq!(gentler.excitation_um, halved);
    assert_eq!(gentler.spans, schedule.spans);
}
