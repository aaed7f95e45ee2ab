// Which session the page shows, and the addresses that belong to it, relative to the page so that a path prefix works.

/** The session named by `?session=ID`; `default` otherwise. */
export const sessionId = new URLSearchParams(location.search).get("session") || "default";

/** Address of something of this session: `""`, `recording`, … */
export function sessionUrl(part: string): URL {
  return new URL(`v1/sessions/${encodeURIComponent(sessionId)}${part && `/${part}`}`, document.baseURI);
}

export function socketUrl(part: "view" | "haptic"): URL {
  const url = sessionUrl(part);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  return url;
}

/** Says why a socket of this session cannot be opened, or null when the server sees nothing wrong. */
export async function whyUnreachable(): Promise<string | null> {
  let response: Response;
  try {
    response = await fetch(sessionUrl(""), { cache: "no-store" });
  } catch {
    return "The server does not answer.";
  }
  if (response.ok) return null;
  if (response.status === 404) return `There is no session “${sessionId}” on this server.`;
  return `The server answers ${response.status} ${response.statusText}.`;
}
