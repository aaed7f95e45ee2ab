//! Who may talk to the server from a browser: `Origin` is the server's own or on the list, and on a loopback listener
//! `Host` names this machine (else a page of another site could reach in by a name that it points here).
//!
//! Programs that send no `Origin` are not browsers and pass.

use super::{App, http::Fail};
use axum::{
    extract::{Request, State},
    http::{HeaderMap, StatusCode, header},
    middleware::Next,
    response::Response,
};
use std::{net::SocketAddr, sync::Arc};

/// The rules of one listener.
#[derive(Debug)]
pub(super) struct Guard {
    loopback: bool,
    /// Allowed origins, lower case, as `scheme://authority`.
    origins: Vec<String>,
}

/// Refuses requests that break the rules.
pub(super) async fn check(
    State(app): State<Arc<App>>,
    request: Request,
    next: Next,
) -> Result<Response, Fail> {
    app.guard.judge(request.headers())?;
    Ok(next.run(request).await)
}

impl Guard {
    /// Rules for a listener at `local`.
    pub(super) fn new(local: SocketAddr, origins: &[String]) -> Guard {
        let origins = origins.iter().map(|o| o.trim_end_matches('/').to_ascii_lowercase()).collect();
        Guard { loopback: local.ip().is_loopback(), origins }
    }

    fn judge(&self, headers: &HeaderMap) -> Result<(), Fail> {
        let text = |name| headers.get(name).map(|v| v.to_str().unwrap_or("?").to_ascii_lowercase());
        let host = text(header::HOST).unwrap_or_default();
        if self.loopback && !local_name(&host) && !self.listed(&host) {
            let message = format!("Host is {host:?}, allowed: localhost or a loopback address");
            return Err(Fail(StatusCode::FORBIDDEN, "host_refused", message));
        }
        let Some(origin) = text(header::ORIGIN) else { return Ok(()) };
        let own = authority(&origin).is_some_and(|a| a == host);
        if own || self.origins.contains(&origin) {
            return Ok(());
        }
        let message =
            format!("Origin is {origin:?}, allowed: the server's own, or one given by --allow-origin");
        Err(Fail(StatusCode::FORBIDDEN, "origin_refused", message))
    }

    /// True when a host is that of an allowed origin, as behind a proxy that keeps `Host`.
    fn listed(&self, host: &str) -> bool {
        self.origins.iter().any(|o| authority(o) == Some(host))
    }
}

/// Host and port of an origin.
fn authority(origin: &str) -> Option<&str> {
    origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"))
}

fn local_name(host: &str) -> bool {
    if let Ok(address) = host.parse::<SocketAddr>() {
        return address.ip().is_loopback();
    }
    let name =
        host.rsplit_once(':').filter(|(_, port)| port.parse::<u16>().is_ok()).map_or(host, |(name, _)| name);
    let bare = name.trim_start_matches('[').trim_end_matches(']');
    name == "localhost"
        || name.ends_with(".localhost")
        || bare.parse::<std::net::IpAddr>().is_ok_and(|a| a.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judge(local: &str, host: &str, origin: Option<&str>) -> bool {
        let guard = Guard::new(local.parse().unwrap(), &["https://cloth.example".into()]);
        let mut headers = HeaderMap::new();
        headers.insert(header::HOST, host.parse().unwrap());
        origin.map(|o| headers.insert(header::ORIGIN, o.parse().unwrap()));
        guard.judge(&headers).is_ok()
    }

    #[test]
    fn loopback_listeners_answer_to_loopback_names_only() {
        for host in
            ["localhost", "localhost:8080", "127.0.0.1:80", "127.9.9.9", "[::1]:1", "[::1]", "a.localhost:3"]
        {
            assert!(judge("127.0.0.1:8080", host, None), "{host}");
        }
        for host in ["evil.example", "evil.example:8080", "192.168.1.5:8080", "localhost.evil.example", ""] {
            assert!(!judge("127.0.0.1:8080", host, None), "{host}");
            assert!(judge("0.0.0.0:8080", host, None), "{host}");
        }
        assert!(judge("127.0.0.1:8080", "cloth.example", None));
    }

    #[test]
    fn origins_are_the_servers_own_or_listed() {
        for origin in ["http://localhost:8080", "https://cloth.example", "HTTP://LOCALHOST:8080"] {
            assert!(judge("127.0.0.1:8080", "localhost:8080", Some(origin)), "{origin}");
        }
        for origin in ["http://localhost:3000", "http://evil.example", "null", "https://cloth.example.evil"] {
            assert!(!judge("127.0.0.1:8080", "localhost:8080", Some(origin)), "{origin}");
        }
    }
}
