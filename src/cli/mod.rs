//! The command line: `serve` (the default), `drive`, `fabric`, `bench`.
