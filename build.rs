//! Makes the folder of the viewer page, so that the server builds before the page does.

fn main() {
    let dist =
        std::path::Path::new(&std::env::var("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("web/dist");
    if let Err(e) = std::fs::create_dir_all(&dist) {
        println!("cargo::warning={}: {e}", dist.display());
    }
    println!("cargo::rerun-if-changed=web/dist");
}
