//! The conformance program of the Rust crate: `afspm test-client -- target/debug/examples/conformance`.

use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use afspm::{Client, ControlMode, Error, Measured, Message, Packet, Region, Response, Result};
use base64::{engine::general_purpose::STANDARD, Engine};
use serde_json::{json, Value};

fn main() -> ExitCode {
    afspm::run(|client| loop {
        let step: Value =
            serde_json::from_str(&client.line(None)?).map_err(|error| Error::Invalid(error.to_string()))?;
        let client = client.clone();
        let waits = ["scan", "spectrum", "wait", "request_control"].contains(&text(&step, "do"));
        let answer = move || {
            let mut answer = done(&client, &step).unwrap_or_else(|error| failed(&error));
            answer["id"] = step["id"].clone();
            println!("{answer}");
        };
        if waits {
            thread::spawn(answer);
        } else {
            answer();
        }
    })
}

fn text<'a>(step: &'a Value, name: &str) -> &'a str {
    step[name].as_str().unwrap_or_default()
}

fn pair(step: &Value, name: &str) -> [f64; 2] {
    [0, 1].map(|i| step[name][i].as_f64().unwrap_or_default())
}

fn bytes(step: &Value, name: &str) -> Result<Vec<u8>> {
    STANDARD.decode(text(step, name)).map_err(|error| Error::Invalid(error.to_string()))
}

fn failed(error: &Error) -> Value {
    match error {
        Error::Refused(refusal) => refused(refusal.response, &refusal.reason, refusal.detail),
        other => json!({"ok": false, "error": other.to_string()}),
    }
}

fn refused(response: u8, reason: &str, detail: u8) -> Value {
    let name = afspm::response_name(response);
    let name = if name.starts_with("REP_") { json!(name) } else { json!(response) };
    json!({"ok": false, "response": name, "reason": reason, "detail": detail})
}

fn done(client: &Client, step: &Value) -> Result<Value> {
    let timeout = step["timeout_s"].as_f64().map(Duration::from_secs_f64);
    let number = |name: &str| step[name].as_u64().unwrap_or_default() as u8;
    let object = |text: &str| serde_json::from_str::<Value>(text).map_err(|error| Error::Wire(error.to_string()));
    match text(step, "do") {
        "ready" => client.wait_ready(timeout)?,
        "decode" => {
            let (message, bytes) = (text(step, "message"), bytes(step, "bytes")?);
            let again = STANDARD.encode(afspm::recoded(message, &bytes)?);
            return Ok(json!({"ok": true, "fields": object(&afspm::to_json(message, &bytes)?)?, "bytes": again}));
        }
        "encode" => {
            let bytes = afspm::from_json(text(step, "message"), &step["fields"].to_string())?;
            return Ok(json!({"ok": true, "bytes": STANDARD.encode(bytes)}));
        }
        "wait" => {
            let packet = client.next(text(step, "prefix"), timeout)?;
            return Ok(with_ok(facts(&packet)));
        }
        "request" => return Ok(answer(client.request(number("number"), &bytes(step, "object")?)?)),
        "request_control" => client.request_control(number("problem"), timeout)?,
        "release_control" => client.release_control()?,
        "get_parameter" => {
            let found = client.get(text(step, "name"))?;
            return Ok(json!({"ok": true, "value": found.value, "unit": found.unit}));
        }
        "set_parameter" => {
            let found = client.set(text(step, "name"), text(step, "value"), step["unit"].as_str())?;
            return Ok(json!({"ok": true, "value": found.value, "unit": found.unit}));
        }
        "action" => client.action(text(step, "name"))?,
        "problem" if step["set"] == true => client.flag(number("number"))?,
        "problem" => client.clear(number("number"))?,
        "mode" => {
            let mode = ControlMode::from_str_name(text(step, "mode"));
            client.set_mode(mode.ok_or_else(|| Error::Invalid("no such mode".into()))?)?;
        }
        "scan" => {
            let region = Region::new(pair(step, "center_m"), pair(step, "size_m"));
            let region = region.turned(step["angle_deg"].as_f64().unwrap_or_default().to_radians());
            let shape = pair(step, "shape").map(|pixels| pixels as usize);
            return Ok(measured("scans", &client.scan(Some(region), Some(shape), None, timeout)?));
        }
        "spectrum" => {
            let spectra = client.spectrum(Some(pair(step, "position_m")), step["kind"].as_str(), None, timeout)?;
            return Ok(measured("spectra", &spectra));
        }
        "state" => return Ok(state(client)),
        "end" => client.end_experiment()?,
        other => return Err(Error::Invalid(format!("there is no step {other:?}"))),
    }
    Ok(json!({"ok": true}))
}

fn answer(response: Response) -> Value {
    if !response.is_success() {
        return refused(response.response, &response.reason, response.detail);
    }
    let name = afspm::response_name(response.response);
    json!({"ok": true, "response": name, "object": STANDARD.encode(response.object)})
}

fn state(client: &Client) -> Value {
    let now = client.state();
    let control = now.control.as_ref();
    json!({
        "ok": true,
        "in_control": now.in_control,
        "holder": control.and_then(|control| control.holder.clone()),
        "mode": control.map_or("CM_UNDEFINED", |control| control.mode.as_str_name()),
        "problems": control.map_or(&[][..], |control| &control.problems),
        "scope_state": now.scope_state.as_str_name(),
    })
}

fn with_ok(mut answer: Value) -> Value {
    answer["ok"] = true.into();
    answer
}

fn measured(name: &str, measured: &Measured) -> Value {
    let facts: Vec<Value> = measured.packets.iter().map(|packet| facts(packet)).collect();
    json!({"ok": true, name: facts, "interruptions": measured.interruptions.len()})
}

fn facts(packet: &Packet) -> Value {
    let mut facts = json!({"envelope": packet.envelope, "message": packet.name, "timestamp_ns": packet.time_ns});
    let about = match &packet.message {
        Message::Scan(scan) | Message::Lines(scan) => json!({
            "channel": scan.channel, "unit": scan.unit, "shape": scan.shape, "view": scan.values.is_view(),
            "center_m": scan.region.center_m, "size_m": scan.region.size_m,
            "angle_deg": scan.region.angle_rad.to_degrees(),
        }),
        Message::Spectrum(spectrum) => json!({
            "kind": spectrum.kind, "names": spectrum.names, "units": spectrum.units, "shape": spectrum.shape,
            "position_m": spectrum.position_m, "view": spectrum.values.is_view(),
        }),
        _ => return facts,
    };
    let values = packet.values();
    let moment: f64 = values.iter().enumerate().map(|(i, value)| i as f64 * value).sum();
    facts.as_object_mut().expect("made above").extend(about.as_object().cloned().expect("made above"));
    facts["values"] = json!({
        "count": values.len(), "first": values.first(), "last": values.last(),
        "sum": values.iter().sum::<f64>(), "moment": moment,
    });
    facts
}
