//! Tells the tests whether the measured recordings lie beside the project: where they do not, the tests that need them are
//! listed as ignored, with the reason.

fn main() {
    let data = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    println!("cargo::rustc-check-cfg=cfg(no_shared_data)");
    println!("cargo::rerun-if-changed={}", data.display());
    if !data.exists() {
        println!("cargo::rustc-cfg=no_shared_data");
    }
}
