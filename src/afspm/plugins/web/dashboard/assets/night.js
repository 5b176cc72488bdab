// Additions to the page of a running experiment for the page of a recorded night.

import "./page.js";
import { Comparison } from "./compare.js";
import { Flipbook } from "./flipbook.js";
import { Scrubber } from "./scrubber.js";

const update = window.afspm.update;
let scrubber = null, asked = false;

async function begin() {
  const night = await (await fetch("night/scans")).json();
  scrubber ??= new Scrubber(document.querySelector("#scrubber"), night);
  if (night.scans.length) {
    window.afspm.comparison = new Comparison(document.querySelector("#compare"), night);
    const flipbook = document.querySelector("#flipbook");
    if (flipbook) window.afspm.flipbook = new Flipbook(flipbook, night);
    scrubber.go(scrubber.last);
  }
  window.afspm.scrubber = scrubber;
}

window.afspm.update = (state) => {
  const theme = update(state);
  if (!asked && document.querySelector("#scrubber")) {
    asked = true;
    begin();
  }
  scrubber?.shown(state.moment);
  return theme;
};
document.body.classList.add("recorded");
