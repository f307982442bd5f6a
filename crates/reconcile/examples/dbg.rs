use cellpos_reconcile::*;
fn main() {
    for dir in std::env::args().skip(1) {
        let mut recs = vec![];
        let mut files: Vec<_> = std::fs::read_dir(&dir).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        for f in files {
            let text = std::fs::read_to_string(&f).unwrap();
            let (mut t, mut u, mut y) = (vec![], vec![], vec![]);
            for l in text.lines().skip(1) {
                let mut c = l.split(',');
                t.push(c.next().unwrap().parse().unwrap());
                u.push(c.next().unwrap().parse().unwrap());
                y.push(c.next().unwrap().trim().parse().unwrap_or(f64::NAN));
            }
            recs.push(Record::from_rows(f.file_stem().unwrap().to_str().unwrap(), &t, &u, &y).unwrap());
        }
        println!("== {dir}");
        let t = std::time::Instant::now(); match reconcile(&cellpos_plant::Model::eq6(), &recs, &Options::default(), &mut |s| eprintln!("  .. {s} {:.1?}", t.elapsed())) { Ok(r) => { println!("{} {:?} closure {:.3} {:.1?}", r.verdict.word(), r.effects.iter().map(|e| (e.id.clone(), e.parameters.iter().map(|(k, v)| format!("{k} {:.5} [{:.5}, {:.5}]", v.value, v.ci95[0], v.ci95[1])).collect::<Vec<_>>(), e.alternatives.clone(), e.explained)).collect::<Vec<_>>(), r.gap.closure(), t.elapsed()); println!("{:#?} gap {} {} {} hyp {:?} shift {:?}", r.places, r.gap.before, r.gap.after, r.gap.floor, r.hypothesis, r.base_shift); } Err(e) => println!("ERR {e}") }
    }
}
