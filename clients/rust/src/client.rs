//! The handle of an experiment: published packets, requests, and the end.

use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::error::{Error, Refusal, Result};
use crate::heartbeat::Heartbeat;
use crate::launch::Launch;
use crate::model::{ControlStatus, Feedback, Packet, Parameter, ScanParameters};
use crate::parent::{self, Pipe};
use crate::proto::{self, ControlMode, ControlRequest, ControlResponse, ScopeState};
use crate::shared::{earlier, Pending, Shared};
use crate::wire::{self, Response};
use crate::{sockets, zmq};

const LONGER_THAN_THE_SCHEDULER: f64 = 1.2; // so that its NO_RESPONSE arrives before the timeout
pub(crate) const NO_RESPONSE: u8 = ControlResponse::RepNoResponse as u8;
const PROBLEMS: [(&str, u8); 4] =
    [("tip-shape-changed", 1), ("device-malfunction", 2), ("feedback-non-optimal", 3), ("thermal-drift", 4)];

/// A component's handle of its experiment, for any number of threads; clones share one connection.
///
/// Calls block until they are done; timeouts are in real time, and `None` waits without limit. After the end
/// of the experiment every call returns [`Error::Ended`], after the end of standard input [`Error::Stopped`].
#[derive(Clone)]
pub struct Client {
    pub(crate) shared: Arc<Shared>,
    pub(crate) requests: Arc<AtomicU64>,
    /// Held by the thread that requests control, or measures.
    pub(crate) asking: Arc<Mutex<()>>,
    pub(crate) measuring: Arc<Mutex<crate::measure::Memory>>,
    threads: Arc<Threads>,
}

struct Threads {
    shared: Arc<Shared>,
    sockets: Mutex<Option<JoinHandle<()>>>,
    heartbeat: Mutex<Option<Heartbeat>>,
}

impl Threads {
    fn end(&self) {
        self.shared.finish(Error::Stopped);
        self.shared.change(|state| {
            if std::mem::take(&mut state.hold.held) {
                let release = wire::request(ControlRequest::ReqReleaseCtrl as u8, b"", &self.last_id());
                state.outbox.push(release);
            }
            state.closing = true;
        });
        self.shared.wake();
        if let Some(thread) = self.sockets.lock().unwrap_or_else(PoisonError::into_inner).take() {
            let _ = thread.join();
        }
        self.heartbeat.lock().unwrap_or_else(PoisonError::into_inner).take();
    }

    fn last_id(&self) -> String {
        format!("{}/{}/{}", self.shared.launch.name, self.shared.session, u32::MAX)
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        self.end();
    }
}

/// The newest published states.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    pub in_control: bool,
    /// None: not yet published.
    pub control: Option<ControlStatus>,
    pub scope_state: ScopeState,
    pub scan_parameters: Option<ScanParameters>,
    pub feedback: Option<Feedback>,
    /// (x, y) in m.
    pub probe_m: Option<[f64; 2]>,
}

impl Client {
    /// Join the experiment that started this process: read the launch line from standard input.
    ///
    /// Standard input then belongs to the client, see [`Client::line`]. When it ends, calls return [`Error::Stopped`],
    /// and a process that still runs 1.5 s later is ended with the exit code 81.
    pub fn launched() -> Result<Client> {
        parent::leave_interrupts_to_parent();
        let mut pipe = Pipe::take()?;
        let line = pipe.line().ok_or_else(|| Error::Config("standard input has no launch line".into()))?;
        let client = Client::open(Launch::from_json(&line)?)?;
        parent::watch(pipe, client.shared.clone());
        Ok(client)
    }

    /// Join a running experiment by the folder of its run, under another name, as `afspm.connect` does.
    pub fn join(run: impl AsRef<Path>, name: &str) -> Result<Client> {
        let launch = Launch::of_guest(run.as_ref(), name)?;
        let patience = launch.request_timeout();
        let client = Client::open(launch)?;
        client.wait_ready(Some(patience))?;
        Ok(client)
    }

    /// Connect as described by a launch line.
    pub fn open(launch: Launch) -> Result<Client> {
        let life = sockets::new_life();
        let session = if launch.run.is_empty() { life } else { format!("{}-{life}", launch.run) };
        let context = zmq::Context::new()?;
        let (waits, wakes) = sockets::waker(&context)?;
        let shared = Arc::new(Shared::new(launch, session, wakes));
        let memory = crate::measure::Memory::of_earlier_life(&shared)?;
        shared.lock().gives_back = !memory.resumes();
        let heartbeat = Mutex::new(Heartbeat::start(&shared.launch, &shared.activity)?);
        let sockets = Mutex::new(Some(sockets::start(&context, waits, &shared)?));
        let threads = Arc::new(Threads { shared: shared.clone(), sockets, heartbeat });
        let (requests, asking) = (Arc::default(), Arc::default());
        Ok(Client { shared, requests, asking, measuring: Arc::new(Mutex::new(memory)), threads })
    }

    /// Leave the experiment: release control, send the closing beat, and end all calls.
    pub fn close(&self) {
        self.threads.end();
    }

    // --- about ---

    pub fn launch(&self) -> &Launch {
        &self.shared.launch
    }

    pub fn name(&self) -> &str {
        &self.shared.launch.name
    }

    /// Return a setting of the component's table in the experiment file; null without it.
    pub fn setting(&self, name: &str) -> &Value {
        &self.shared.launch.settings[name]
    }

    /// Return the experiment's time in ns since 1970.
    pub fn now_ns(&self) -> i64 {
        self.shared.launch.clock.now_ns()
    }

    /// Write a line into the log of the experiment; `level` is INFO, WARNING, ERROR or DEBUG.
    pub fn log(&self, level: &str, text: &str) {
        eprintln!("{level} {text}");
    }

    /// Set the longest time between two calls, by default 30 s. After it the process counts as frozen.
    pub fn allow_step(&self, longest: Duration) {
        self.shared.activity.allow(longest);
    }

    /// Return the newest published states of microscope and control.
    pub fn state(&self) -> Snapshot {
        let state = self.shared.lock();
        Snapshot {
            in_control: state.hold.held,
            control: state.view.control.clone(),
            scope_state: state.view.scope_state(),
            scan_parameters: state.view.scan_parameters,
            feedback: state.view.feedback,
            probe_m: state.view.probe_m,
        }
    }

    // --- packets ---

    /// Wait until the scheduler is connected and all packets of its cache have arrived.
    pub fn wait_ready(&self, timeout: Option<Duration>) -> Result<()> {
        let needs_replay = !self.shared.launch.sockets.subscribe.is_empty();
        let needs_control = self.shared.launch.sockets.control.is_some();
        let ready = self.shared.wait(until(timeout), |state| {
            ((state.caught_up || !needs_replay) && (state.connected || !needs_control)).then_some(())
        })?;
        ready.ok_or_else(|| Error::TimedOut("the scheduler does not answer; is the experiment running?".into()))
    }

    /// Return the oldest unread packet whose envelope begins with `prefix`.
    ///
    /// Packets wait in up to 256 MB of memory; beyond that the oldest are dropped, and their number is logged.
    pub fn next(&self, prefix: &str, timeout: Option<Duration>) -> Result<Arc<Packet>> {
        let found = self.shared.wait(until(timeout), |state| {
            let packet = state.next_packet(prefix)?;
            Some((packet, state.take_dropped()))
        })?;
        let (packet, dropped) = found.ok_or_else(|| Error::TimedOut(format!("no packet {prefix:?} came in time")))?;
        if dropped > 0 {
            self.log("WARNING", &format!("{dropped} packets were dropped, since they were not taken in time"));
        }
        Ok(packet)
    }

    /// Return the next line of standard input after the launch line, for programs with more input.
    pub fn line(&self, timeout: Option<Duration>) -> Result<String> {
        let line = self.shared.wait(until(timeout), |state| state.lines.pop_front())?;
        line.ok_or_else(|| Error::TimedOut("no line came in time".into()))
    }

    // --- requests ---

    pub(crate) fn next_id(&self) -> String {
        let number = 1 + self.requests.fetch_add(1, Ordering::Relaxed);
        format!("{}/{}/{number}", self.shared.launch.name, self.shared.session)
    }

    /// Send a request, and return its answer, also a refusal.
    ///
    /// Without an answer it is repeated with the same id, so that it is executed once. The wait lasts while no scheduler is
    /// connected. Without any answer: REP_NO_RESPONSE, with the detail 1 if it was never sent, otherwise 2.
    pub fn request(&self, number: u8, object: &[u8]) -> Result<Response> {
        self.request_as(&self.next_id(), number, object, None)
    }

    /// `request` with an id that an earlier life may have used.
    pub(crate) fn request_as(&self, id: &str, number: u8, object: &[u8], until: Option<Instant>) -> Result<Response> {
        self.shared.lock().pending.insert(id.to_owned(), Pending::default());
        let answer = self.repeat(id, number, object, until);
        let pending = self.shared.lock().pending.remove(id).unwrap_or_default();
        let reason = "the scheduler does not answer".to_owned();
        Ok(answer?.unwrap_or_else(|| Response {
            response: NO_RESPONSE,
            detail: if pending.sent { 2 } else { 1 },
            reason,
            ..Response::default()
        }))
    }

    fn repeat(&self, id: &str, number: u8, object: &[u8], until: Option<Instant>) -> Result<Option<Response>> {
        let launch = &self.shared.launch;
        let (timeout, tries) = (launch.request_timeout(), 1 + launch.request_retries);
        let mut tried = 0;
        while tried < tries {
            let connected = |state: &mut crate::shared::State| state.connected.then_some(state.connections);
            let Some(connection) = self.shared.wait(earlier(timeout * tries, until), connected)? else { break };
            self.shared.change(|state| state.outbox.push(wire::request(number, object, id)));
            self.shared.wake();
            let try_until = earlier(timeout.mul_f64(LONGER_THAN_THE_SCHEDULER), until);
            let heard = self.shared.wait(try_until, |state| {
                let answer = state.pending.get_mut(id).and_then(|pending| pending.answer.take());
                (answer.is_some() || state.connections != connection).then_some(answer)
            })?;
            match heard {
                Some(Some(answer)) => return Ok(Some(answer)),
                Some(None) => {} // a lost connection is a restart of the scheduler, not silence
                None if until.is_some_and(|until| Instant::now() >= until) => break,
                None => tried += 1,
            }
        }
        Ok(None)
    }

    /// `request`, with an error for anything but success.
    pub(crate) fn command(&self, what: &str, kind: ControlRequest, object: &[u8]) -> Result<Response> {
        let response = self.request(kind as u8, object)?;
        if response.is_success() {
            Ok(response)
        } else {
            Err(refused(what, response))
        }
    }

    /// Return the value of a parameter as text, in its unit.
    pub fn get(&self, parameter: &str) -> Result<Parameter> {
        let object = wire::parameter(parameter, None, None);
        wire::parameter_from(&self.command(parameter, ControlRequest::ReqParam, &object)?.object)
    }

    /// Set a parameter, and return the value in force. Needs control.
    pub fn set(&self, parameter: &str, value: &str, unit: Option<&str>) -> Result<Parameter> {
        let object = wire::parameter(parameter, Some(value), unit);
        wire::parameter_from(&self.command(parameter, ControlRequest::ReqParam, &object)?.object)
    }

    /// Set the given parts of the z feedback. Needs control.
    pub fn set_feedback(&self, feedback: &Feedback) -> Result<()> {
        self.command("the feedback", ControlRequest::ReqSetZctrlParams, &wire::feedback(feedback)).map(drop)
    }

    /// Perform an action by its name, such as "x-retract". Needs control.
    pub fn action(&self, name: &str) -> Result<()> {
        self.command(name, ControlRequest::ReqAction, &wire::action(name)).map(drop)
    }

    /// Return whether the microscope has an action, without performing it.
    pub fn supports(&self, action: &str) -> Result<bool> {
        let response = self.request(ControlRequest::ReqActionSupport as u8, &wire::action(action))?;
        match ControlResponse::try_from(i32::from(response.response)) {
            Ok(ControlResponse::RepSuccess) => Ok(true),
            Ok(ControlResponse::RepActionNotSupported | ControlResponse::RepCmdNotSupported) => Ok(false),
            _ => Err(refused(action, response)),
        }
    }

    /// Return the number of a problem by its name: one of the wire format's or of the experiment file's.
    pub fn problem(&self, name: &str) -> Result<u8> {
        let known = PROBLEMS.iter().find(|(known, _)| *known == name).map(|(_, number)| *number);
        let named = known.or_else(|| self.shared.launch.problems.get(name).copied());
        named.ok_or_else(|| Error::Invalid(format!("there is no problem {name:?}")))
    }

    /// Flag a problem: it revokes control until a component clears the problem.
    pub fn flag(&self, problem: u8) -> Result<()> {
        self.command("flagging a problem", ControlRequest::ReqAddExpPrblm, &[problem]).map(drop)
    }

    /// Clear a problem.
    pub fn clear(&self, problem: u8) -> Result<()> {
        self.command("clearing a problem", ControlRequest::ReqRmvExpPrblm, &[problem]).map(drop)
    }

    /// Set MANUAL (no component has control) or AUTOMATED.
    pub fn set_mode(&self, mode: ControlMode) -> Result<()> {
        self.command("the mode", ControlRequest::ReqSetControlMode, &[mode as u8]).map(drop)
    }

    /// End the experiment for all; the next call returns [`Error::Ended`].
    pub fn end_experiment(&self) -> Result<()> {
        match self.command("ending the experiment", ControlRequest::ReqEndExperiment, b"") {
            Err(Error::Ended) => Ok(()), // the signal may come before the answer
            other => other.map(drop),
        }
    }

    /// Publish the component's progress: `done` of `of`.
    pub fn progress(&self, done: u64, of: u64) -> Result<()> {
        let timestamp = Some(wire::timestamp(self.now_ns()));
        let name = Some(self.name().to_owned());
        let progress = proto::Progress { timestamp, name, done: Some(done), of: Some(of), remaining: None };
        self.tell("Progress", &progress)
    }

    /// Write a remark of 1 to 1000 characters into the record, on the scan finished at `scan_ns` or on now.
    pub fn note(&self, text: &str, scan_ns: Option<i64>) -> Result<()> {
        let now_ns = self.now_ns();
        self.tell(
            "Note",
            &proto::Note {
                timestamp: Some(wire::timestamp(scan_ns.unwrap_or(now_ns))),
                who: Some(self.name().to_owned()),
                text: Some(text.to_owned()),
                scan: scan_ns.map(wire::timestamp),
                written: Some(wire::timestamp(now_ns)),
            },
        )
    }

    fn tell<T: prost::Message>(&self, name: &str, message: &T) -> Result<()> {
        let response = self.request(wire::RELAY, &wire::told(name, message))?;
        if response.is_success() {
            Ok(())
        } else {
            Err(refused(name, response))
        }
    }
}

/// Return the end of a timeout.
pub(crate) fn until(timeout: Option<Duration>) -> Option<Instant> {
    timeout.and_then(|timeout| Instant::now().checked_add(timeout))
}

pub(crate) fn refused(what: &str, response: Response) -> Error {
    if response.detail == 3 {
        return Error::Ended;
    }
    let Response { response, reason, detail, .. } = response;
    Error::Refused(Refusal { what: what.to_owned(), response, reason, detail })
}
