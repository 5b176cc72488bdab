//! The C face of the `afspm` crate, described in `include/afspm.h`: handles, plain values, and texts copied to the caller.

#![allow(clippy::missing_safety_doc)] // the same for all: pointers are valid as the header says, or null

mod measured;
mod texts;

use std::ffi::{c_char, c_double, c_int};
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use native::{Client, ControlMode, Error, Feedback, Launch, Parameter, Refusal, Region, Response, Result};

use measured::Packets;
use texts::{copy, put, required, text, TooSmall};

const OK: c_int = 0;
const REFUSED: c_int = 1;
const TOO_SMALL: c_int = 9;
const PANICKED: c_int = 10;

/// A connection to an experiment, or the reason why there is none.
pub struct Handle {
    client: Option<Client>,
    last: Mutex<Last>,
}

/// What became of the last call of a handle.
#[derive(Default)]
struct Last {
    message: String,
    refusal: Option<Refusal>,
    /// A line that did not fit into the caller's buffer.
    line: Option<String>,
}

/// What a call ends with beside success.
enum Failure {
    Error(Error),
    TooSmall,
}

impl From<Error> for Failure {
    fn from(error: Error) -> Failure {
        Failure::Error(error)
    }
}

impl From<TooSmall> for Failure {
    fn from(_: TooSmall) -> Failure {
        Failure::TooSmall
    }
}

type Outcome = std::result::Result<(), Failure>;

fn code(error: &Error) -> c_int {
    match error {
        Error::Refused(_) => REFUSED,
        Error::TimedOut(_) => 2,
        Error::MeasurementFailed(_) => 3,
        Error::Invalid(_) => 4,
        Error::Wire(_) => 5,
        Error::Transport(_) => 6,
        Error::File(_) => 7,
        Error::Config(_) | Error::Ended | Error::Stopped => c_int::from(error.exit_code()),
    }
}

fn invalid(what: &str) -> Failure {
    Failure::Error(Error::Invalid(what.to_owned()))
}

impl Handle {
    fn client(&self) -> Result<&Client> {
        self.client.as_ref().ok_or_else(|| Error::Invalid("this handle is not connected".into()))
    }

    fn last(&self) -> std::sync::MutexGuard<'_, Last> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn note(&self, error: &Error) {
        let mut last = self.last();
        last.message = error.to_string();
        last.refusal = if let Error::Refused(refusal) = error { Some(refusal.clone()) } else { None };
    }
}

/// Run a call: whatever goes wrong becomes a code, and the handle's message.
unsafe fn call(handle: *const Handle, work: impl FnOnce(&Handle, &Client) -> Outcome) -> c_int {
    let Some(handle) = handle.as_ref() else { return 4 };
    let outcome = catch_unwind(AssertUnwindSafe(|| work(handle, handle.client()?)));
    match outcome {
        Ok(Ok(())) => OK,
        Ok(Err(Failure::TooSmall)) => TOO_SMALL,
        Ok(Err(Failure::Error(error))) => {
            handle.note(&error);
            code(&error)
        }
        Err(_) => {
            handle.note(&Error::Invalid("a fault of the library: please report it".into()));
            PANICKED
        }
    }
}

/// `call` without a handle.
fn plain(work: impl FnOnce() -> Outcome) -> c_int {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(())) => OK,
        Ok(Err(Failure::TooSmall)) => TOO_SMALL,
        Ok(Err(Failure::Error(error))) => code(&error),
        Err(_) => PANICKED,
    }
}

unsafe fn open(out: *mut *mut Handle, connect: impl FnOnce() -> Result<Client>) -> c_int {
    let Some(out) = out.as_mut() else { return 4 };
    let opened = catch_unwind(AssertUnwindSafe(connect)).unwrap_or_else(|_| Err(Error::Invalid("a fault".into())));
    let result = opened.as_ref().map_or_else(code, |_| OK);
    let message = opened.as_ref().err().map(ToString::to_string).unwrap_or_default();
    let last = Mutex::new(Last { message, ..Last::default() });
    *out = Box::into_raw(Box::new(Handle { client: opened.ok(), last }));
    result
}

fn timeout(seconds: c_double) -> Option<Duration> {
    Duration::try_from_secs_f64(seconds).ok() // negative, infinite: as long as it takes
}

fn byte(number: c_int) -> Result<u8> {
    u8::try_from(number).map_err(|_| Error::Invalid(format!("{number} is not between 0 and 255")))
}

// --- joining and leaving ---

#[no_mangle]
pub unsafe extern "C" fn afspm_launched(out: *mut *mut Handle) -> c_int {
    open(out, Client::launched)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_join(run: *const c_char, name: *const c_char, out: *mut *mut Handle) -> c_int {
    open(out, || Client::join(required(run)?, required(name)?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_open(launch_line: *const c_char, out: *mut *mut Handle) -> c_int {
    open(out, || Client::open(Launch::from_json(required(launch_line)?)?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_clone(handle: *const Handle, out: *mut *mut Handle) -> c_int {
    let client = handle.as_ref().and_then(|handle| handle.client.clone());
    open(out, || client.ok_or_else(|| Error::Invalid("there is nothing to clone".into())))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_leave(handle: *const Handle) -> c_int {
    call(handle, |_, client| {
        client.close();
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_free(handle: *mut Handle) {
    if !handle.is_null() {
        let handle = Box::from_raw(handle);
        let _ = catch_unwind(AssertUnwindSafe(|| drop(handle)));
    }
}

// --- what went wrong ---

#[no_mangle]
pub unsafe extern "C" fn afspm_error_message(handle: *const Handle, out: *mut c_char, capacity: c_int) -> c_int {
    let message = handle.as_ref().map_or("there is no handle".into(), |handle| handle.last().message.clone());
    copy(&message, out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_refusal(handle: *const Handle, response: *mut c_int, detail: *mut c_int) -> c_int {
    let refusal = handle.as_ref().and_then(|handle| handle.last().refusal.clone());
    let (number, more) = refusal.map_or((0, 0), |refusal| (refusal.response, refusal.detail));
    put(response, c_int::from(number));
    put(detail, c_int::from(more));
    OK
}

#[no_mangle]
pub unsafe extern "C" fn afspm_refusal_reason(handle: *const Handle, out: *mut c_char, capacity: c_int) -> c_int {
    let refusal = handle.as_ref().and_then(|handle| handle.last().refusal.clone());
    copy(&refusal.map(|refusal| refusal.reason).unwrap_or_default(), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_response_name(response: c_int, out: *mut c_char, capacity: c_int) -> c_int {
    let name = byte(response).map_or_else(|_| response.to_string(), native::response_name);
    copy(&name, out, capacity)
}

// --- about ---

#[no_mangle]
pub unsafe extern "C" fn afspm_name(handle: *const Handle, out: *mut c_char, capacity: c_int) -> c_int {
    let name = handle.as_ref().and_then(|handle| handle.client.as_ref()).map(|client| client.name().to_owned());
    copy(&name.unwrap_or_default(), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_run_folder(handle: *const Handle, out: *mut c_char, capacity: c_int) -> c_int {
    let client = handle.as_ref().and_then(|handle| handle.client.as_ref());
    let folder = client.map(|client| client.launch().run_dir.to_string_lossy().into_owned());
    copy(&folder.unwrap_or_default(), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_setting(
    handle: *const Handle,
    name: *const c_char,
    out: *mut c_char,
    capacity: c_int,
) -> c_int {
    call(handle, |_, client| {
        let value = client.setting(required(name)?);
        if value.is_null() {
            return Err(invalid("there is no such setting"));
        }
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        Ok(texts::fit(&value, out, capacity)?)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_setting_number(handle: *const Handle, name: *const c_char, out: *mut c_double) -> c_int {
    call(handle, |_, client| {
        let value = client.setting(required(name)?).as_f64();
        put(out, value.ok_or_else(|| invalid("there is no such setting, or it is no number"))?);
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_now_ns(handle: *const Handle, out: *mut i64) -> c_int {
    call(handle, |_, client| {
        put(out, client.now_ns());
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_log(handle: *const Handle, level: *const c_char, line: *const c_char) -> c_int {
    call(handle, |_, client| {
        client.log(required(level)?, required(line)?);
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_allow_step(handle: *const Handle, longest_s: c_double) -> c_int {
    call(handle, |_, client| {
        client.allow_step(timeout(longest_s).ok_or_else(|| invalid("a step takes zero or more seconds"))?);
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_state(
    handle: *const Handle,
    in_control: *mut c_int,
    mode: *mut c_int,
    scope_state: *mut c_int,
) -> c_int {
    call(handle, |_, client| {
        let now = client.state();
        put(in_control, c_int::from(now.in_control));
        put(mode, now.control.map_or(0, |control| control.mode as c_int));
        put(scope_state, now.scope_state as c_int);
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_holder(handle: *const Handle, out: *mut c_char, capacity: c_int) -> c_int {
    let client = handle.as_ref().and_then(|handle| handle.client.as_ref());
    let holder = client.and_then(|client| client.state().control).and_then(|control| control.holder);
    copy(&holder.unwrap_or_default(), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_problems(
    handle: *const Handle,
    out: *mut c_int,
    capacity: c_int,
    count: *mut c_int,
) -> c_int {
    call(handle, |_, client| {
        let problems = client.state().control.map_or(Vec::new(), |control| control.problems);
        put(count, problems.len() as c_int);
        let problems: Vec<c_int> = problems.into_iter().map(c_int::from).collect();
        Ok(texts::fit_all(&problems, out, i64::from(capacity))?)
    })
}

// --- packets ---

#[no_mangle]
pub unsafe extern "C" fn afspm_wait_ready(handle: *const Handle, timeout_s: c_double) -> c_int {
    call(handle, |_, client| Ok(client.wait_ready(timeout(timeout_s))?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_next(
    handle: *const Handle,
    prefix: *const c_char,
    timeout_s: c_double,
    out: *mut *mut Packets,
) -> c_int {
    call(handle, |_, client| {
        let packet = client.next(text(prefix)?.unwrap_or(""), timeout(timeout_s))?;
        Packets::hand_out(vec![packet], Vec::new(), out)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_line(
    handle: *const Handle,
    timeout_s: c_double,
    out: *mut c_char,
    capacity: c_int,
) -> c_int {
    call(handle, |handle, client| {
        let kept = handle.last().line.take();
        let line = kept.map_or_else(|| client.line(timeout(timeout_s)), Ok)?;
        if line.len() >= usize::try_from(capacity).unwrap_or(0) {
            handle.last().line = Some(line);
            return Err(Failure::TooSmall);
        }
        copy(&line, out, capacity);
        Ok(())
    })
}

// --- requests ---

#[no_mangle]
pub unsafe extern "C" fn afspm_request(
    handle: *const Handle,
    number: c_int,
    object: *const u8,
    size: i64,
    answer: *mut u8,
    capacity: i64,
    answer_size: *mut i64,
) -> c_int {
    call(handle, |_, client| {
        let Response { response, object, reason, detail, .. } =
            client.request(byte(number)?, texts::bytes(object, size)?)?;
        put(answer_size, object.len() as i64);
        if response != 0 {
            let what = format!("request {number}");
            return Err(Failure::Error(Error::Refused(Refusal { what, response, reason, detail })));
        }
        Ok(texts::fit_all(&object, answer, capacity)?)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_request_control(handle: *const Handle, problem: c_int, timeout_s: c_double) -> c_int {
    call(handle, |_, client| Ok(client.request_control(byte(problem)?, timeout(timeout_s))?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_release_control(handle: *const Handle) -> c_int {
    call(handle, |_, client| Ok(client.release_control()?))
}

unsafe fn hand_out(found: &Parameter, value: *mut c_char, room: c_int, unit: *mut c_char, unit_room: c_int) -> Outcome {
    texts::fit(&found.value, value, room)?;
    Ok(texts::fit(found.unit.as_deref().unwrap_or(""), unit, unit_room)?)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_get(
    handle: *const Handle,
    parameter: *const c_char,
    value: *mut c_char,
    value_capacity: c_int,
    unit: *mut c_char,
    unit_capacity: c_int,
) -> c_int {
    call(handle, |_, client| hand_out(&client.get(required(parameter)?)?, value, value_capacity, unit, unit_capacity))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_set(
    handle: *const Handle,
    parameter: *const c_char,
    value: *const c_char,
    unit: *const c_char,
) -> c_int {
    call(handle, |_, client| {
        client.set(required(parameter)?, required(value)?, text(unit)?)?;
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_set_feedback(
    handle: *const Handle,
    on: c_int,
    proportional_gain: c_double,
    integral_gain: c_double,
    setpoint: c_double,
) -> c_int {
    call(handle, |_, client| {
        let given = |value: c_double| (!value.is_nan()).then_some(value as f32);
        Ok(client.set_feedback(&Feedback {
            on: (on >= 0).then_some(on > 0),
            proportional_gain: given(proportional_gain),
            integral_gain: given(integral_gain),
            setpoint: given(setpoint),
        })?)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_action(handle: *const Handle, name: *const c_char) -> c_int {
    call(handle, |_, client| Ok(client.action(required(name)?)?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_supports(handle: *const Handle, action: *const c_char, out: *mut c_int) -> c_int {
    call(handle, |_, client| {
        put(out, c_int::from(client.supports(required(action)?)?));
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_problem(handle: *const Handle, name: *const c_char, out: *mut c_int) -> c_int {
    call(handle, |_, client| {
        put(out, c_int::from(client.problem(required(name)?)?));
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_flag(handle: *const Handle, problem: c_int) -> c_int {
    call(handle, |_, client| Ok(client.flag(byte(problem)?)?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_clear(handle: *const Handle, problem: c_int) -> c_int {
    call(handle, |_, client| Ok(client.clear(byte(problem)?)?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_set_mode(handle: *const Handle, mode: c_int) -> c_int {
    call(handle, |_, client| {
        let mode = ControlMode::try_from(mode).map_err(|_| invalid("there is no such mode"))?;
        Ok(client.set_mode(mode)?)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_end_experiment(handle: *const Handle) -> c_int {
    call(handle, |_, client| Ok(client.end_experiment()?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_progress(handle: *const Handle, done: i64, of: i64) -> c_int {
    call(handle, |_, client| {
        let count = |number: i64| u64::try_from(number).map_err(|_| invalid("progress counts from zero"));
        Ok(client.progress(count(done)?, count(of)?)?)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_note(handle: *const Handle, line: *const c_char, scan_ns: i64) -> c_int {
    call(handle, |_, client| Ok(client.note(required(line)?, (scan_ns != i64::MIN).then_some(scan_ns))?))
}

// --- measuring ---

fn region(values: [c_double; 5]) -> Option<Region> {
    let [x, y, width, height, angle_rad] = values;
    (width != 0.0 || height != 0.0).then_some(Region { center_m: [x, y], size_m: [width, height], angle_rad })
}

fn shape(rows: c_int, columns: c_int) -> Option<[usize; 2]> {
    let pixels = |count: c_int| usize::try_from(count).unwrap_or(0);
    (rows != 0 || columns != 0).then_some([pixels(rows), pixels(columns)])
}

#[no_mangle]
pub unsafe extern "C" fn afspm_move_probe(handle: *const Handle, x_m: f64, y_m: f64, timeout_s: c_double) -> c_int {
    call(handle, |_, client| Ok(client.move_probe([x_m, y_m], timeout(timeout_s))?))
}

#[no_mangle]
#[allow(clippy::too_many_arguments)] // no structures by value: LabVIEW can't pass them
pub unsafe extern "C" fn afspm_set_scan_region(
    handle: *const Handle,
    x_m: c_double,
    y_m: c_double,
    width_m: c_double,
    height_m: c_double,
    angle_rad: c_double,
    rows: c_int,
    columns: c_int,
    timeout_s: c_double,
) -> c_int {
    call(handle, |_, client| {
        let region = region([x_m, y_m, width_m, height_m, angle_rad]).ok_or_else(|| invalid("a region has a size"))?;
        Ok(client.set_scan_region(region, shape(rows, columns), timeout(timeout_s))?)
    })
}

#[no_mangle]
#[allow(clippy::too_many_arguments)]
pub unsafe extern "C" fn afspm_scan(
    handle: *const Handle,
    x_m: c_double,
    y_m: c_double,
    width_m: c_double,
    height_m: c_double,
    angle_rad: c_double,
    rows: c_int,
    columns: c_int,
    key: *const c_char,
    timeout_s: c_double,
    out: *mut *mut Packets,
) -> c_int {
    call(handle, |_, client| {
        let region = region([x_m, y_m, width_m, height_m, angle_rad]);
        let found = client.scan(region, shape(rows, columns), text(key)?, timeout(timeout_s))?;
        Packets::hand_out(found.packets, found.interruptions, out)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_spectrum(
    handle: *const Handle,
    x_m: c_double,
    y_m: c_double,
    kind: *const c_char,
    key: *const c_char,
    timeout_s: c_double,
    out: *mut *mut Packets,
) -> c_int {
    call(handle, |_, client| {
        let place = (!x_m.is_nan() && !y_m.is_nan()).then_some([x_m, y_m]);
        let found = client.spectrum(place, text(kind)?, text(key)?, timeout(timeout_s))?;
        Packets::hand_out(found.packets, found.interruptions, out)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_forget(handle: *const Handle, key: *const c_char) -> c_int {
    call(handle, |_, client| Ok(client.forget(required(key)?)?))
}
