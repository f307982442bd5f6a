//! Build script of the crates whose tests read measured records: where those lie.
//!
//! `MEASURED_DATA` is the collection next to the project if it exists, else the small set of the repository (tests/data). With the
//! small set `no_shared_data` is set, and tests that need more are listed as ignored, with the reason.

use std::path::Path;

fn main() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let (beside, small) = (root.join("../shared/data"), root.join("tests/data"));
    println!("cargo::rustc-check-cfg=cfg(no_shared_data)");
    println!("cargo::rerun-if-changed={}", beside.display());
    let folder = if beside.exists() {
        beside
    } else {
        println!("cargo::rustc-cfg=no_shared_data");
        small
    };
    println!("cargo::rustc-env=MEASURED_DATA={}", folder.display());
}
