/** Headless Chromium for visits of the pages, which draws with WebGL by software. */

import { createRequire } from "node:module";

/**
 * Visits a page and closes the browser afterwards.
 * @param {string} modules Folder node_modules with playwright-core.
 * @param {object} viewport `width` and `height`, px.
 * @param {(page: object, seen: object) => Promise<object>} visit `seen` has `errors` of the
 *   page, and `requests`, the addresses that it asked for.
 * @returns What the visit returns, with the errors.
 */
export async function visiting(modules, viewport, visit) {
  const { chromium } = createRequire(`${modules}/`)("playwright-core");
  const browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: [
      "--no-sandbox",
      "--disable-gpu",
      "--use-gl=angle",
      "--use-angle=swiftshader",
      "--enable-unsafe-swiftshader",
      "--disable-quic",
      "--no-first-run",
      "--disable-background-networking",
      "--disable-component-update",
      "--disable-sync",
    ],
  });
  const seen = { errors: [], requests: [] };
  try {
    const page = await browser.newPage({ viewport });
    page.on("pageerror", (error) => seen.errors.push(error.message));
    page.on("console", (said) => said.type() === "error" && seen.errors.push(said.text()));
    page.on("requestfailed", (request) => seen.errors.push(`not loaded: ${request.url()}`));
    page.on("request", (request) => seen.requests.push(request.url()));
    return { ...(await visit(page, seen)), errors: seen.errors };
  } catch (error) {
    throw new Error(`${error.message}; errors of the page: ${seen.errors.join("; ") || "none"}`);
  } finally {
    await browser.close();
  }
}
