// The page's own behaviour in the browser. NiceGUI does the rest.

import { ImageView } from "./image.js";

const LOST_AFTER_MS = 6000;
let image = null;
let updated = Date.now();
let ended = false;
let watched = null;
let noteBegunOn = "";

/** Update the page. The dashboard calls this twice a second; the returned theme also shows that the browser keeps up. */
function update(state) {
  updated = Date.now();
  ended = state.ended;
  watchSocket();
  const root = document.querySelector("#image");
  if (!image && root) image = new ImageView(root);
  image?.setChannels(state.channels);
  image?.hear(state.newest);
  image?.setSteering(state.may_measure, state.may_grant);
  if (!document.querySelector("[role=tab][aria-selected=true]")) chooseTab(document.body.dataset.tab);
  showTrouble(state.trouble);
  allowSteering(!ended);
  return localStorage.getItem("afspm-theme") ?? "";
}

/** Enable or disable the controls: without a connection or an experiment they have no effect. */
function allowSteering(may) {
  for (const element of document.querySelectorAll(".steer, .processes, .problems, .bar > .q-btn")) element.inert = !may;
}

function showTrouble(text) {
  const element = document.querySelector("#trouble");
  if (!element) return;
  if (element.textContent !== text) element.textContent = text;
  element.hidden = !text;
  document.body.classList.toggle("old", Boolean(text));
}

function tellLost() {
  allowSteering(false);
  image?.setSteering(false);
  const seconds = Math.round((Date.now() - updated) / 1000);
  showTrouble(ended ? "The experiment has ended. What is shown is how it ended; \"afspm dashboard\" shows the whole night."
    : `The connection to the dashboard is lost: what is shown is ${seconds} s old. It is tried again.`);
}

/** Show a lost connection at once: a restarted dashboard may be back before the next check. */
function watchSocket() {
  if (!window.socket || watched === window.socket) return;
  watched = window.socket;
  watched.on("disconnect", tellLost);
}

setInterval(() => {
  if (Date.now() - updated >= LOST_AFTER_MS || window.socket?.connected === false) tellLost();
}, 1000);

document.addEventListener("click", (event) => {
  const tab = event.target.closest?.("[role=tab]");
  if (tab) showTab(tab.dataset.tab);
  const shape = event.target.closest?.("[data-time], [data-spectrum]");
  if (!shape?.closest(".map, .strip, .notes")) return;
  if (shape.dataset.spectrum) emitEvent("spectrum_picked", { time: shape.dataset.spectrum });
  else {
    image?.pin({ time: shape.dataset.time, channel: shape.dataset.channel });
    showTab("scan");
    emitEvent("scan_picked", { time: shape.dataset.time, channel: shape.dataset.channel });
  }
});
document.addEventListener("click", (event) => {
  if (event.target.dataset?.part === "live") emitEvent("scan_picked", {});
});

// A note is on the scan that its author saw: a later scan may be shown before the server hears of the first letter.
document.addEventListener("beforeinput", (event) => {
  if (event.target.matches?.(".noted .text input") && !event.target.value) noteBegunOn = image?.head?.time_ns ?? "";
});

/** Choose the part of the page that a phone shows. */
function chooseTab(name) {
  document.body.dataset.tab = name;
  for (const tab of document.querySelectorAll("[role=tab]")) tab.setAttribute("aria-selected", String(tab.dataset.tab === name));
}
document.body.dataset.tab = "scan";

function showTab(name) {
  chooseTab(name);
  window.scrollTo(0, 0);
}

/** Measure the header, so that the style sheet lets the first rows fill the rest of the screen. */
function observeTop() {
  const top = document.querySelector(".top");
  if (!top) return;
  new ResizeObserver(() => document.documentElement.style.setProperty("--top", `${top.offsetHeight}px`)).observe(top);
}
if (document.readyState === "complete") observeTop();
else window.addEventListener("load", observeTop);

window.afspm = {
  update,
  keepTheme: (name) => localStorage.setItem("afspm-theme", name),
  pin: (scan) => image?.pin(scan),
  /** The times of the scan shown and of the one that a note is on: the pinned one, or the one shown when it was begun. */
  scansToNote: () => {
    const shown = image?.head?.time_ns ?? "";
    return [shown, image?.pinned ? shown : noteBegunOn || shown];
  },
  get image() {
    return image;
  },
  get updated() {
    return updated;
  },
};
