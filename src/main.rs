//! The `kesi` binary: hands its arguments to `kesi::cli`.

fn main() -> std::process::ExitCode {
    kesi::cli::main()
}
