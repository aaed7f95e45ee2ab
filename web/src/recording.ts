// The link to the session's recording. A session that is not recorded says so, instead of a page of JSON.

import { sessionId, sessionUrl } from "./session";

export function recordingLink(link: HTMLAnchorElement, tell: (text: string) => void): void {
  link.href = sessionUrl("recording").href;
  link.download = `${sessionId}.rrd`;
  let checked = false;
  link.addEventListener("click", async (event) => {
    if (checked) {
      checked = false;
      return; // the browser downloads
    }
    event.preventDefault();
    const why = await refusal();
    if (why !== null) {
      tell(why);
      return;
    }
    checked = true;
    link.click();
  });
}

/** The server's reason for not giving the recording, or null. */
async function refusal(): Promise<string | null> {
  const abort = new AbortController();
  try {
    const response = await fetch(sessionUrl("recording"), { signal: abort.signal, cache: "no-store" });
    if (response.ok) return null;
    const body = (await response.json()) as { error?: { message?: string } };
    return body.error?.message ?? `The server answers ${response.status}.`;
  } catch {
    return "The recording cannot be reached.";
  } finally {
    abort.abort();
  }
}
