// The viewer in a real Chromium against the real server: loads, drags the corner, sees the force change, survives an outage.
//
// Environment: KESI_BIN (the binary), CHROMIUM (default: found on PATH), KESI_SCREENSHOTS (a folder: pictures are
// written there, in full quality). Every wait is bounded; the exit code is 1 when anything fails.

import { spawn, execFileSync } from "node:child_process";
import { mkdirSync } from "node:fs";
import { join, resolve } from "node:path";
import { chromium } from "playwright-core";

/** A software renderer on a busy machine draws once a second. */
const STEP_MS = 60_000;
const WHOLE_MS = 600_000;

const kesi = process.env.KESI_BIN ?? resolve(import.meta.dirname, "../../target/release/kesi");
const pictures = process.env.KESI_SCREENSHOTS || null;
if (pictures) mkdirSync(pictures, { recursive: true });
const query = pictures ? "?quality=full" : "";

let server = null;
let browser = null;
/** The page under test, whose state is shown beside a failure. */
let shown = null;
let passed = 0;
let failed = 0;

const watchdog = setTimeout(() => {
  console.error(`gave up after ${WHOLE_MS / 1000} s`);
  finish(1);
}, WHOLE_MS);
for (const signal of ["SIGINT", "SIGTERM"]) process.on(signal, () => finish(1));

async function finish(code) {
  clearTimeout(watchdog);
  server?.process.kill("SIGKILL");
  await Promise.race([browser?.close(), new Promise((done) => setTimeout(done, 5000))]);
  process.exit(code);
}

/** Runs one check; a check that fails does not stop the next. */
async function check(name, body) {
  const start = performance.now();
  try {
    await body();
    passed += 1;
    console.log(`ok    ${name} (${((performance.now() - start) / 1000).toFixed(1)} s)`);
  } catch (error) {
    failed += 1;
    console.error(`FAIL  ${name}\n      ${String(error.message).split("\n").join("\n      ")}`);
    const state = await shown?.evaluate(() => JSON.stringify({ ...document.documentElement.dataset, log: document.getElementById("log").innerText || document.getElementById("log").textContent })).catch(() => "gone");
    if (state) console.error(`      page: ${state}`);
  }
}

function expect(condition, text) {
  if (!condition) throw new Error(text);
}

/** Starts the server and waits for the line that tells its address. */
function serve(listen) {
  const child = spawn(kesi, ["serve", "--listen", listen, "--record", "off"], { stdio: ["ignore", "pipe", "pipe"] });
  return new Promise((resolveAddress, reject) => {
    let out = "";
    let err = "";
    const timeout = setTimeout(() => reject(new Error(`no address from ${kesi}: ${out}${err}`)), STEP_MS);
    child.on("error", reject);
    child.on("exit", (code) => reject(new Error(`${kesi} ended with ${code}: ${err}`)));
    child.stderr.on("data", (data) => (err = (err + data).slice(-4000)));
    child.stdout.on("data", (data) => {
      out += data;
      const address = out.match(/kesi listening on http:\/\/(\S+)/)?.[1];
      if (!address) return;
      clearTimeout(timeout);
      child.removeAllListeners("exit");
      resolveAddress({ process: child, address });
    });
  });
}

function stop({ process: child }) {
  return new Promise((done) => {
    if (child.exitCode !== null) return done();
    child.once("exit", done);
    child.kill("SIGKILL");
  });
}

function findChromium() {
  if (process.env.CHROMIUM) return process.env.CHROMIUM;
  for (const name of ["chromium", "chromium-browser", "google-chrome"]) {
    try {
      return execFileSync("sh", ["-c", `command -v ${name}`], { encoding: "utf8" }).trim();
    } catch {
      // the next name
    }
  }
  throw new Error("no Chromium found: install one or name it in CHROMIUM");
}

async function open(options, address, search = query) {
  const context = await browser.newContext(options);
  const page = await context.newPage();
  const errors = [];
  page.on("console", (message) => {
    if (message.type() === "error") errors.push(message.text());
  });
  page.on("pageerror", (error) => errors.push(String(error)));
  page.setDefaultTimeout(STEP_MS);
  shown = page;
  await page.goto(`http://${address}/${search}`);
  return { page, errors, close: () => context.close() };
}

const data = (page) => page.evaluate(() => ({ ...document.documentElement.dataset }));
const until = (page, condition, argument) => page.waitForFunction(condition, argument, { timeout: STEP_MS, polling: 100 });
const numbers = (text) => text.split(" ").map(Number);
const distance = (a, b) => Math.hypot(...a.map((x, n) => x - b[n]));
const live = (page) => until(page, () => {
  const { state, frames, handPx } = document.documentElement.dataset;
  return state === "connected" && Number(frames) >= 1 && handPx;
});

/** Waits until the hand is more than a centimetre from a place. */
const movedFrom = (page, place) => until(page, (from) => {
  const at = document.documentElement.dataset.handM.split(" ").map(Number);
  return Math.hypot(...at.map((x, n) => x - from[n])) > 0.01;
}, place);

/** Waits until the handle stands still on the page, so that a press hits it. */
async function still(page) {
  let before = "";
  for (let n = 0; n < 100; n++) {
    const { handPx } = await data(page);
    if (handPx === before) return numbers(handPx);
    before = handPx;
    await page.waitForTimeout(200);
  }
  throw new Error("the handle never stood still");
}

async function run() {
  server = await serve("127.0.0.1:0");
  browser = await chromium.launch({
    executablePath: findChromium(),
    args: [
      "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
      "--disable-background-networking", "--disable-component-update", "--disable-sync",
    ],
  });

  const desk = await open({ viewport: pictures ? { width: 1440, height: 900 } : { width: 960, height: 640 } }, server.address);
  const { page } = desk;

  await check("the page connects and draws the cloth", () => live(page));

  await check("the panel names fabric, scene and session", async () => {
    for (const id of ["fabric", "fabric-kind", "scene", "session", "lattice", "active"]) {
      const text = await page.textContent(`#${id}`);
      expect(text && text !== "–", `#${id} shows ${JSON.stringify(text)}`);
    }
    expect((await page.textContent("#session")) === "default", "the session is not the default one");
  });

  await check("dragging the corner moves the hand and changes the force", async () => {
    const [x, y] = await still(page);
    const before = await data(page);
    await page.mouse.move(x, y);
    await page.mouse.down();
    await until(page, () => document.documentElement.dataset.grab === "held");
    // To and fro until it is seen: one pull may end at the force that it began with, between pictures that show another.
    const [from, force] = [numbers(before.handM), Number(before.forceN)];
    const start = performance.now();
    for (let n = 1, seen = false; !seen || n % 24 !== 12; n++) {
      const pull = 12 - Math.abs((n % 24) - 12);
      await page.mouse.move(x - 4 * pull, y - 5 * pull);
      await page.waitForTimeout(40);
      const { handM, forceN } = await data(page);
      seen ||= distance(numbers(handM), from) > 0.01 && Math.abs(Number(forceN) - force) > 0.02 * Math.max(force, 1e-3);
      expect(seen || performance.now() - start < STEP_MS, `from ${force} N the force came to ${forceN} N, the hand to ${handM} m`);
    }
    expect((await page.textContent("#holder")) === "yours", "the panel does not say that the hand is ours");
    if (pictures) {
      await page.waitForTimeout(4000);
      await page.screenshot({ path: join(pictures, "viewer-drag.png") });
    }
  });

  await check("holding still keeps the grab", async () => {
    await page.waitForTimeout(1500);
    expect((await data(page)).grab === "held", "the grab was lost while holding still");
  });

  await check("a hand that was silent for too long is taken again, and goes on", async () => {
    const from = numbers((await data(page)).handM);
    // Longer than the lease.
    await page.workers()[0].evaluate(() => {
      for (const end = performance.now() + 400; performance.now() < end; );
    });
    await until(page, () => document.getElementById("log").textContent.includes("taken again"));
    const at = numbers((await data(page)).handPx);
    for (let n = 1; n <= 12; n++) await page.mouse.move(at[0] - 4 * n, at[1] - 5 * n);
    await movedFrom(page, from);
    expect((await data(page)).grab === "held", "the grab was lost");
  });

  await check("letting go of the button gives the corner back, and it stays", async () => {
    await page.mouse.up();
    await until(page, () => document.documentElement.dataset.grab === "free");
    // Told by a frame of after the release: what a busy machine shows may be older.
    await until(page, () => document.getElementById("holder").textContent === "the scene");
    const released = numbers((await data(page)).handM);
    await page.waitForTimeout(1000);
    expect(distance(released, numbers((await data(page)).handM)) < 0.01, "the corner did not stay where it was released");
  });

  await check("arrow keys move the corner", async () => {
    const before = numbers((await data(page)).handM);
    await page.focus("#canvas");
    for (let n = 0; n < 5; n++) await page.keyboard.press("ArrowUp");
    await movedFrom(page, before);
    await page.keyboard.press("Escape");
    await until(page, () => document.documentElement.dataset.grab === "free");
  });

  await check("dragging the background turns the view and holds nothing", async () => {
    const before = await still(page);
    // The corner of the picture that is farthest from the hand.
    const [[x, y]] = [[30, 90], [30, 560], [560, 90], [560, 560]].sort((a, b) => distance(b, before) - distance(a, before));
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.mouse.move(x + 60, y, { steps: 4 });
    expect((await data(page)).grab === "free", "the background was grabbed");
    await page.mouse.up();
    await until(page, (from) => {
      const at = document.documentElement.dataset.handPx.split(" ").map(Number);
      return Math.hypot(...at.map((x, n) => x - from[n])) > 5;
    }, before);
    await page.keyboard.press("r");
  });

  if (pictures) {
    await page.evaluate(() => document.activeElement.blur());
    await page.waitForTimeout(4000);
    await page.screenshot({ path: join(pictures, "viewer.png") });
  }

  const phone = await open({ viewport: { width: 390, height: 844 }, deviceScaleFactor: pictures ? 2 : 1, hasTouch: true, isMobile: true }, server.address);
  await check("a phone shows the cloth, and the sheet opens", async () => {
    await live(phone.page);
    const wide = await phone.page.evaluate(() => document.documentElement.scrollWidth);
    expect(wide <= 390, `the page is ${wide} px wide on a phone of 390`);
    if (pictures) {
      await phone.page.waitForTimeout(4000);
      await phone.page.screenshot({ path: join(pictures, "viewer-phone.png") });
    }
    await phone.page.tap("#sheet-toggle");
    await until(phone.page, () => document.getElementById("force-plot").getBoundingClientRect().top < innerHeight - 60);
    if (pictures) {
      await phone.page.waitForTimeout(4000);
      await phone.page.screenshot({ path: join(pictures, "viewer-phone-open.png") });
    }
  });
  await phone.close();

  await check("no errors on either page's console", () => {
    const errors = [...desk.errors, ...phone.errors];
    expect(errors.length === 0, errors.join("\n"));
  });

  const nowhere = await open({ viewport: { width: 640, height: 480 } }, server.address, "?session=nowhere");
  await check("a session that is not there is told in words", () =>
    until(nowhere.page, () => document.getElementById("outage-text").textContent.includes("no session “nowhere”")));
  await nowhere.close();

  await check("an outage is told, and the page comes back by itself", async () => {
    await stop(server);
    await until(page, () => document.documentElement.dataset.state !== "connected" && !document.getElementById("outage").hidden);
    const before = Number((await data(page)).frames);
    server = await serve(server.address);
    await until(page, (frames) => {
      const page = document.documentElement.dataset;
      return page.state === "connected" && Number(page.frames) > frames;
    }, before);
  });
}

try {
  await run();
} catch (error) {
  failed += 1;
  console.error(`FAIL  ${error.stack ?? error}`);
}
console.log(`browser: ${passed} passed, ${failed} failed`);
await finish(failed === 0 ? 0 : 1);
