// What the page does by itself. Everything else is NiceGUI's.

import { ImageView } from "./image.js";

const LOST_AFTER_MS = 6000;
let image = null;
let updated = Date.now();
let ended = false;
let watched = null;

/** Called by the dashboard several times a second; its answer says that we keep up. */
function update(state) {
  updated = Date.now();
  ended = state.ended;
  watchSocket();
  const root = document.querySelector("#image");
  if (!image && root) image = new ImageView(root);
  image?.setChannels(state.channels);
  image?.setSteering(state.may_measure);
  showTrouble(state.trouble);
  allowSteering(!ended);
  return localStorage.getItem("afspm-theme") ?? "";
}

/** What would reach nobody can't be pressed. */
function allowSteering(may) {
  for (const element of document.querySelectorAll(".steer, .processes")) element.inert = !may;
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
  showTrouble(ended ? "The experiment has ended, and the dashboard with it. What is shown is how it ended."
    : `The connection to the dashboard is lost: what is shown is ${seconds} s old. It is tried again.`);
}

/** At once, and not at the next look: a dashboard that is started again may be back before that. */
function watchSocket() {
  if (!window.socket || watched === window.socket) return;
  watched = window.socket;
  watched.on("disconnect", tellLost);
}

setInterval(() => {
  if (Date.now() - updated >= LOST_AFTER_MS || window.socket?.connected === false) tellLost();
}, 1000);

document.addEventListener("click", (event) => {
  const shape = event.target.closest?.("[data-time], [data-spectrum]");
  if (!shape?.closest(".map")) return;
  if (shape.dataset.spectrum) emitEvent("spectrum_picked", { time: shape.dataset.spectrum });
  else {
    image?.pin({ time: shape.dataset.time, channel: shape.dataset.channel });
    emitEvent("scan_picked", { time: shape.dataset.time, channel: shape.dataset.channel });
  }
});
document.addEventListener("click", (event) => {
  if (event.target.dataset?.part === "live") emitEvent("scan_picked", {});
});

window.afspm = {
  update,
  keepTheme: (name) => localStorage.setItem("afspm-theme", name),
  pin: (scan) => image?.pin(scan),
  get image() {
    return image;
  },
};
