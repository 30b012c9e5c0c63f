/**
 * Visits the page on which one steers, in headless Chromium, holds keys and says what
 * came of it.
 *
 *   node visit.mjs NODE_MODULES ADDRESS SCREENSHOT.png [KEY:SECONDS …]
 *
 * "Pad:SECONDS" in place of a key pushes with the left stick of a gamepad that the page
 * is told of, whose vibrations are counted. Prints a JSON object: simulated seconds, insertion (m), distance (m), the largest
 * contact (N), milliseconds of a control step, and errors of the page.
 */

import { visiting } from "./headless.mjs";

const [modules, address, screenshot, ...keys] = process.argv.slice(2);
const result = await visiting(modules, { width: 1560, height: 760 }, async (page) => {
  await page.addInitScript(() => {
    globalThis.pad = { connected: false, mapping: "standard", axes: [0, -1, 0, 0],
      buttons: [], felt: [], vibrationActuator: { playEffect: async (kind, how) => {
        globalThis.pad.felt.push(how.strongMagnitude);
      } } };
    navigator.getGamepads = () => [null, globalThis.pad];
  });
  await page.goto(address);
  await page.waitForFunction(() => globalThis.cathsim, null, { timeout: 300_000 });
  for (const key of keys) {
    const [name, seconds] = key.split(":");
    if (name === "Pad") {
      await page.evaluate(() => { globalThis.pad.connected = true; });
      await page.waitForTimeout(1e3 * Number(seconds));
      await page.evaluate(() => { globalThis.pad.connected = false; });
      continue;
    }
    const held = name.split("+");
    for (const each of held) await page.keyboard.down(each);
    await page.waitForTimeout(1e3 * Number(seconds));
    for (const each of held) await page.keyboard.up(each);
  }
  const state = await page.evaluate(() => {
    const { simulation, milliseconds, peaks } = globalThis.cathsim.state;
    return {
      seconds: simulation.time,
      inserted: simulation.inserted,
      distance: simulation.distance,
      largest: Math.max(0, ...peaks),
      milliseconds,
      felt: globalThis.pad.felt.length,
    };
  });
  await page.screenshot({ path: screenshot });
  return state;
});
console.log(JSON.stringify(result));
