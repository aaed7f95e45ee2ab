//! `kesi serve`: configuration, port and signals around `server::run`. Stdout gets one line; logs go to stderr.

use super::Done;
use crate::{
    config::{Config, Mistakes, Settings},
    fabric::Library,
    scene::Scene,
    server,
    session::Plan,
};
use std::{
    io::{ErrorKind, IsTerminal, Write},
    net::SocketAddr,
    path::{Path, PathBuf},
    thread,
};
use tokio::{net::TcpListener, runtime};
use tracing_subscriber::EnvFilter;

/// Flags of `kesi serve`; each overrides the configuration file, which overrides the defaults.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Args {
    /// Address and port; port 0 takes a free one.
    #[arg(long, value_name = "ADDR")]
    listen: Option<String>,
    /// Scene of the session `default`: a built-in name or a TOML file.
    #[arg(long, value_name = "NAME|FILE.toml")]
    scene: Option<String>,
    /// Folder of recordings, or `off`.
    #[arg(long, value_name = "DIR|off")]
    record: Option<String>,
    /// Address where live rerun viewers may connect, or `off`.
    #[arg(long, value_name = "ADDR|off")]
    rerun_serve: Option<String>,
    /// Web origin besides the server's own that may connect; may be repeated.
    #[arg(long, value_name = "ORIGIN")]
    allow_origin: Vec<String>,
    /// Configuration file.
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Prints the configuration that these flags make, as TOML, and ends.
    #[arg(long)]
    print_config: bool,
}

impl Args {
    /// The file, overlaid by the flags, and what is wrong with the file.
    fn configuration(&self) -> (Config, Vec<String>) {
        let (mut config, wrong) = self.config.as_deref().map(Config::read).unwrap_or_default();
        for (flag, key) in [
            (&self.listen, &mut config.listen),
            (&self.scene, &mut config.scene),
            (&self.record, &mut config.record),
            (&self.rerun_serve, &mut config.rerun_serve),
        ] {
            if let Some(value) = flag {
                key.clone_from(value);
            }
        }
        config.allow_origin.extend(self.allow_origin.iter().cloned());
        (config, wrong)
    }

    /// Everything that serving needs, or everything that is wrong.
    fn check(&self) -> Result<(Settings, Plan), Mistakes> {
        let (config, mut wrong) = self.configuration();
        let plan = plan(&config.scene).map_err(|e| wrong.push(e));
        let settings = config.check().map_err(|Mistakes(more)| wrong.extend(more));
        match (settings, plan) {
            (Ok(settings), Ok(plan)) if wrong.is_empty() => Ok((settings, plan)),
            _ => Err(Mistakes(wrong)),
        }
    }
}

/// The scene that a name or file means.
fn plan(scene: &str) -> Result<Plan, String> {
    let path = Path::new(scene);
    if path.extension().is_none() {
        return Plan::of(&Scene::named(scene).map_err(|e| format!("{e}, or a .toml file"))?);
    }
    let scene = Scene::read(path, &Library::default()).map_err(|e| e.to_string())?;
    Plan::of(&scene)
}

/// Serves until SIGINT or SIGTERM.
pub(super) fn run(args: &Args) -> Done {
    if args.print_config {
        let (config, wrong) = args.configuration();
        if !wrong.is_empty() {
            return Err(Mistakes(wrong).into());
        }
        print!("{}", config.to_toml());
        return Ok(());
    }
    let (settings, plan) = args.check()?;
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("kesi=info"));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    let _ = log.with_ansi(std::io::stderr().is_terminal()).try_init();
    // Session threads are the clocks: sockets leave them a core where there are several.
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let workers = cores.saturating_sub(1).clamp(1, 4);
    let runtime = runtime::Builder::new_multi_thread().worker_threads(workers).enable_all().build()?;
    let served = runtime.block_on(serve(settings, plan));
    // Blocking work that outlived the deadline must not hold the process.
    runtime.shutdown_background();
    served
}

async fn serve(settings: Settings, plan: Plan) -> Done {
    let listen = settings.listen;
    let listener = TcpListener::bind(listen).await.map_err(|e| {
        let way_out = if e.kind() == ErrorKind::AddrInUse { "; port 0 takes a free one" } else { "" };
        format!("listen is {listen}: {e}{way_out}")
    })?;
    announce(listener.local_addr()?)?;
    server::run(listener, settings, plan, signal()?).await?;
    Ok(())
}

/// The one line on stdout.
fn announce(address: SocketAddr) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "kesi listening on http://{address}")?;
    out.flush()
}

/// Completes at the first SIGINT or SIGTERM.
#[cfg(unix)]
fn signal() -> std::io::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut int, mut term) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = int.recv() => {}
            _ = term.recv() => {}
        }
    })
}

/// Completes at the first Ctrl-C.
#[cfg(not(unix))]
fn signal() -> std::io::Result<impl Future<Output = ()>> {
    Ok(async {
        let _ = tokio::signal::ctrl_c().await;
    })
}
