// Takes a scan over HTTP in JavaScript, and follows the events meanwhile: node scan.mjs [ADDRESS [NAME]]
const [address = "http://127.0.0.1:8090", name = "javascript"] = process.argv.slice(2);
const headers = { Authorization: `Bearer ${name}:${process.env.TOKEN ?? ""}`, "Content-Type": "application/json" };

async function ask(method, path, body) {
  const answer = await fetch(`${address}/v1${path}`, { method, headers, body: body && JSON.stringify(body) });
  const told = await answer.json();
  if (!answer.ok) throw new Error(`${told.code}: ${told.reason}. ${told.advice}`);
  return told;
}

/** Yields the events after `last`; connects again where it was cut off, and goes on there. */
async function* events(kinds, last) {
  const wanted = kinds.map((kind) => `kinds=${kind}`).join("&");
  for (;;) {
    const stream = await fetch(`${address}/v1/events?${wanted}`, { headers: { ...headers, "Last-Event-ID": last } });
    let text = "";
    try {
      for await (const piece of stream.body.pipeThrough(new TextDecoderStream())) {
        text += piece;
        for (let end; (end = text.indexOf("\n\n")) >= 0; text = text.slice(end + 2)) {
          const event = Object.fromEntries(text.slice(0, end).split("\n").map((line) => line.split(/: (.*)/s)));
          if (event.id) last = event.id;
          if (event.event === "end") return;
          if (event.data) yield { kind: event.event, ...JSON.parse(event.data) };
        }
      }
    } catch (error) {
      console.log(`cut off: ${error.message}`);
    }
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
}

const state = await ask("GET", "/state");
console.log(`${state.mode}, ${state.holder ?? "nobody"} is in control, the microscope is ${state.microscope.state}`);
await ask("POST", "/control?wait_s=20", { lease_s: 60 });
try {
  const region = { center_m: [1e-6, 0], size_m: [5e-7, 5e-7] };
  await ask("POST", "/scans", { region, shape: [64, 64], settings: { "tip-bias-voltage": 0.5 }, key: `${name}-1` });
  for await (const event of events(["state", "scan"], state.last_event)) {
    console.log(event.kind, event.data.state ?? event.data.channel);
    const measured = await ask("GET", `/measurements/${name}-1`);
    if (measured.state === "failed") throw new Error(measured.refusal.reason);
    if (measured.state !== "done") continue;
    const told = await ask("GET", `/scans/${measured.result}/values?channel=Height&format=base64`);
    const bytes = Uint8Array.from(atob(told.base64), (letter) => letter.charCodeAt(0));
    const heights = new Float64Array(bytes.buffer);
    const highest = heights.reduce((one, other) => Math.max(one, other));
    console.log(`${told.shape.join(" x ")} pixels, the highest at ${(highest * 1e9).toFixed(1)} nm`);
    break;
  }
} finally {
  await ask("DELETE", "/control");
}
process.exit(0);
