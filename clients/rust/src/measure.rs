//! Measurement of a scan or spectrum, repeated after interruptions; with a key, once in all lives of the component.

use std::collections::BTreeSet;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use crate::client::{refused, until, Client, NO_RESPONSE};
use crate::cycle::{Cycle, Outcome, Target};
use crate::error::{Error, Result};
use crate::keyed::{self, Intent};
use crate::model::{Packet, Region, Scan, ScanParameters, Spectrum};
use crate::proto::{ControlRequest, ControlResponse, ScopeState};
use crate::shared::{earlier, Counts, Shared, State};
use crate::wire::{self, Response};

const BEGUN_WITHIN: Duration = Duration::from_secs(5); // from the success of the action to its published state
const PATIENCE: Duration = Duration::from_secs(60); // longest absence of a translator
const RETRY: Duration = Duration::from_secs(1); // before an unreachable one is asked again
const SETTLED_WITHIN: Duration = Duration::from_secs(2); // a setting that changed something is published within this time
const ASK_FREE_AGAIN: Duration = Duration::from_secs(5); // should the state FREE never come
const MOST_FAILURES: u32 = 5; // in a row, that nothing explains
const SAME: f64 = 1e-6; // of the size: finer than any controller positions
const NOT_IN_CONTROL: [u8; 2] = [ControlResponse::RepNotInControl as u8, ControlResponse::RepWrongControlMode as u8];
const NOT_FREE: u8 = ControlResponse::RepNotFree as u8;

/// What was measured, all channels of it.
#[derive(Debug, Clone)]
pub struct Measured {
    /// One packet for each channel, or one spectrum.
    pub packets: Vec<Arc<Packet>>,
    /// Why it was begun anew, each time, for a person.
    pub interruptions: Vec<String>,
}

impl Measured {
    /// Return the channels of a scan.
    pub fn scans(&self) -> impl Iterator<Item = &Scan> {
        self.packets.iter().filter_map(|packet| packet.scan())
    }

    /// Return a channel of a scan by its name.
    pub fn scan(&self, channel: &str) -> Option<&Scan> {
        self.scans().find(|scan| scan.channel == channel)
    }

    pub fn spectra(&self) -> impl Iterator<Item = &Spectrum> {
        self.packets.iter().filter_map(|packet| packet.spectrum())
    }
}

/// What is known from one measurement to the next.
#[derive(Default)]
pub struct Memory {
    /// The cycle that watches for what an earlier life, or an earlier call, asked for and did not get.
    unfinished: Option<u64>,
    cycles: u64,
    channels: BTreeSet<String>,
    rounded: Option<(ScanParameters, ScanParameters)>,
}

impl Memory {
    pub fn of_earlier_life(shared: &Shared) -> Result<Memory> {
        let mut memory = Memory::default();
        if let Some(intent) = keyed::pending(&shared.launch)? {
            let cycle = Cycle::new(intent.target, Some(intent.since_ns.unwrap_or(-1)), true);
            memory.unfinished = Some(memory.watch(shared, cycle));
        }
        Ok(memory)
    }

    /// Return whether an earlier life has left a measurement to be taken up.
    pub fn resumes(&self) -> bool {
        self.unfinished.is_some()
    }

    fn watch(&mut self, shared: &Shared, cycle: Cycle) -> u64 {
        self.cycles += 1;
        shared.lock().cycles.insert(self.cycles, cycle);
        self.cycles
    }
}

struct Task<'a> {
    target: Target,
    key: Option<&'a str>,
    /// Of the ids of the action that begins it: another in every attempt, the same in every life.
    stem: String,
    until: Option<Instant>,
    attempt: u64,
    failures: u32,
    interruptions: Vec<String>,
    watch: Option<u64>,
}

impl Client {
    /// Take a scan, and return all its channels.
    ///
    /// Control is asked for and waited for, and given back unless it was there before. A scan that is interrupted
    /// (a problem, MANUAL, a restart of scheduler or translator) is taken again when control is back.
    ///
    /// * `region`: where; None: what is set.
    /// * `shape`: [rows, columns]; None: what is set.
    /// * `key`: 1 to 100 characters without '/'; makes it happen once in this run: a component that is killed and started
    ///   again gets the scan of its earlier life. Each key is for one measurement.
    pub fn scan(
        &self,
        region: Option<Region>,
        shape: Option<[usize; 2]>,
        key: Option<&str>,
        timeout: Option<Duration>,
    ) -> Result<Measured> {
        let region = region.map(Region::checked).transpose()?;
        if shape.is_some_and(|shape| shape.iter().any(|pixels| !(1..=1 << 20).contains(pixels))) {
            return Err(Error::Invalid(format!("a scan of {shape:?} rows and columns")));
        }
        let drifts = self.shared.launch.sample_coordinates;
        self.take(Target::Scan { region, shape, drifts }, key, until(timeout))
    }

    /// Take a spectrum at (x, y) in m, or where the probe stands; interruptions and `key` as with [`Client::scan`].
    ///
    /// `kind`: such as "IV" (the parameter `x-spec-kind`); None: what is set.
    pub fn spectrum(
        &self,
        at_m: Option<[f64; 2]>,
        kind: Option<&str>,
        key: Option<&str>,
        timeout: Option<Duration>,
    ) -> Result<Measured> {
        if at_m.is_some_and(|xy| !xy.iter().all(|value| value.is_finite())) {
            return Err(Error::Invalid(format!("{at_m:?} is no place")));
        }
        let drifts = self.shared.launch.sample_coordinates;
        self.take(Target::Spectrum { at_m, kind: kind.map(str::to_owned), drifts }, key, until(timeout))
    }

    /// Remove what is kept of a keyed measurement that will not be asked for again.
    pub fn forget(&self, key: &str) -> Result<()> {
        keyed::forget(&self.shared.launch, keyed::checked(key)?)
    }

    /// Move the probe to (x, y) in m; returns when it stands there. It needs control.
    pub fn move_probe(&self, xy_m: [f64; 2], timeout: Option<Duration>) -> Result<()> {
        self.set_and_settle(
            ControlRequest::ReqSetProbePos,
            &wire::position(xy_m),
            |counts| counts.probe,
            until(timeout),
        )
    }

    /// Set where the next scan is taken and its pixels; returns when it is in force. It needs control.
    pub fn set_scan_region(&self, region: Region, shape: Option<[usize; 2]>, timeout: Option<Duration>) -> Result<()> {
        let wanted = ScanParameters { region: Some(region.checked()?), shape };
        self.set_frame(&wanted, until(timeout))
    }

    fn take(&self, target: Target, key: Option<&str>, until: Option<Instant>) -> Result<Measured> {
        let launch = &self.shared.launch;
        if let Some(found) = key.map(|key| keyed::find(launch, keyed::checked(key)?, &target)).transpose()?.flatten() {
            return Ok(found);
        }
        let mut memory = self.measuring.lock().unwrap_or_else(PoisonError::into_inner);
        // cached results must not count as new ones
        self.waited(
            until,
            |state| (state.caught_up && state.connected).then_some(()),
            "the scheduler does not answer",
        )?;
        let stem = key.map_or_else(|| self.next_id(), |key| format!("{}/key/{key}", launch.name));
        let watch = None;
        let mut task = Task { target, key, stem, until, attempt: 0, failures: 0, interruptions: vec![], watch };
        let result = self.take_up(&mut task, &mut memory).and_then(|()| self.finish(&mut task, &mut memory));
        let is_going_on = task.watch.is_some_and(|watch| self.outcome(watch).is_none());
        if result.is_err() && key.is_some() && is_going_on {
            memory.unfinished = task.watch.take(); // its key leads to the result later
        }
        self.drop_watch(&mut task);
        let measured = Measured { packets: newest_of_each(result?), interruptions: task.interruptions };
        if let Some(key) = key {
            keyed::fulfil(launch, key, &task.target, &measured)?;
        }
        Ok(measured)
    }

    /// Continue this measurement if an earlier life or call had started it.
    fn take_up(&self, task: &mut Task, memory: &mut Memory) -> Result<()> {
        let Some(watch) = memory.unfinished.take() else { return Ok(()) };
        let intent = keyed::pending(&self.shared.launch)?;
        match intent.filter(|intent| Some(&*intent.key) == task.key && intent.target == task.target) {
            Some(intent) => {
                self.log("INFO", &format!("{} {}: resumed", task.target.what(), intent.key));
                (task.attempt, task.interruptions, task.watch) = (intent.attempt, intent.interruptions, Some(watch));
            }
            None if task.key.is_none() => {
                // what comes now is not of it; what has come is kept for the call with its key
                self.wait_if_begun(watch, task.until)?;
                memory.unfinished = Some(watch);
            }
            None => drop(self.shared.lock().cycles.remove(&watch)),
        }
        Ok(())
    }

    fn finish(&self, task: &mut Task, memory: &mut Memory) -> Result<Vec<Arc<Packet>>> {
        if let Some(watch) = task.watch {
            self.wait_if_begun(watch, task.until)?;
            if self.outcome(watch) == Some(Outcome::Completed) {
                if self.shared.lock().inherits_control(self.name()) {
                    self.request(ControlRequest::ReqReleaseCtrl as u8, b"")?; // others wait for it
                }
                return Ok(self.results(watch));
            }
        }
        self.hold(task.until)?;
        let result = self.measure(task, memory);
        let released = self.release();
        let packets = result?;
        released.map(|()| packets)
    }

    /// Repeat attempts until one is complete.
    fn measure(&self, task: &mut Task, memory: &mut Memory) -> Result<Vec<Arc<Packet>>> {
        loop {
            if let Some(watch) = task.watch {
                if self.outcome(watch).is_some() {
                    if let Some(packets) = self.completed(task, memory, watch)? {
                        return Ok(packets);
                    }
                    self.drop_watch(task);
                }
            }
            self.attempt(task, memory)?;
        }
    }

    /// Return the results if they are complete; else note why not, before the next attempt.
    fn completed(&self, task: &mut Task, memory: &mut Memory, watch: u64) -> Result<Option<Vec<Arc<Packet>>>> {
        let (outcome, packets) = (self.outcome(watch), self.results(watch));
        let channels: BTreeSet<String> =
            packets.iter().filter_map(|packet| Some(packet.scan()?.channel.clone())).collect();
        let is_scan = matches!(task.target, Target::Scan { .. });
        let is_missing = is_scan && !memory.channels.is_subset(&channels);
        if outcome == Some(Outcome::Completed) && !is_missing {
            if is_scan {
                memory.channels = channels;
            }
            return Ok(Some(packets));
        }
        if is_missing && outcome == Some(Outcome::Completed) {
            memory.channels.clear(); // the same again: then these channels are not recorded any more
        }
        let (held, why_lost) = {
            let state = self.shared.lock();
            (state.hold.held, state.hold.why_lost.clone())
        };
        let why = match outcome {
            _ if !held => format!("control was lost: {why_lost}"),
            Some(Outcome::Interrupted) => "something else stopped it".into(),
            Some(Outcome::Another) => "not what was asked for was measured; who else sets the microscope?".into(),
            Some(Outcome::Completed) => "without channels that it had before".into(),
            _ => "the microscope is free again without a result; was it restarted?".to_owned(),
        };
        self.log("WARNING", &format!("{} interrupted: {why}; retrying", task.target.what()));
        // a loss of control is a known reason; all else must not go on for a night
        task.failures = if held { task.failures + 1 } else { 0 };
        if task.failures >= MOST_FAILURES {
            return Err(Error::MeasurementFailed(format!(
                "the {} failed {MOST_FAILURES} times: {why}",
                task.target.what()
            )));
        }
        task.interruptions.push(why);
        Ok(None)
    }

    /// Prepare and begin once, and follow to the end.
    ///
    /// What was asked for in an earlier life is asked for with the same id, so that it is not executed twice; so is what
    /// was left without an answer when control was lost. Leaves no watch where nothing was begun.
    fn attempt(&self, task: &mut Task, memory: &mut Memory) -> Result<()> {
        self.regain(task.until)?;
        let is_new = task.watch.is_none();
        if task.watch.is_some_and(|watch| self.outcome(watch).is_some()) {
            return Ok(()); // it had started, and ended during the wait for control
        }
        if is_new {
            task.attempt += 1;
            self.write_down(task)?;
        }
        self.prepare(&task.target, memory, task.until)?;
        let counts = self.counts();
        let since_ns = self.shared.lock().view.newest_ns;
        let watch = *task
            .watch
            .get_or_insert_with(|| memory.watch(&self.shared, Cycle::new(task.target.clone(), since_ns, false)));
        let id = format!("{}/{}", task.stem, task.attempt);
        let object = wire::action(task.target.start());
        let response = self.send(ControlRequest::ReqAction, &object, &id, task.until, Some(watch))?;
        if response.is_success() || self.is_begun(watch) {
            return self.follow(task, watch);
        }
        let may_have_begun = response.response == NO_RESPONSE || !is_new && NOT_IN_CONTROL.contains(&response.response);
        if may_have_begun {
            self.shared.change(|state| state.cycles.get_mut(&watch).map(Cycle::control_was_lost));
        } else {
            self.drop_watch(task);
        }
        match self.get_over(task.target.start(), response, counts, task.until) {
            // an earlier id would return the earlier refusal from memory; another id returns the present answer
            Err(Error::Refused(_)) if !is_new => Ok(()),
            other => other,
        }
    }

    fn write_down(&self, task: &Task) -> Result<()> {
        let Some(key) = task.key else { return Ok(()) };
        keyed::intend(
            &self.shared.launch,
            &Intent {
                key: key.to_owned(),
                target: task.target.clone(),
                attempt: task.attempt,
                since_ns: self.shared.lock().view.newest_ns,
                interruptions: task.interruptions.clone(),
            },
        )
    }

    /// Follow a measurement from the success of its action to its end.
    fn follow(&self, task: &mut Task, watch: u64) -> Result<()> {
        let timed_out = || Error::TimedOut(format!("the {} was not finished in time; it goes on", task.target.what()));
        loop {
            // the wait lasts while the scheduler is away
            let connection = self.waited(task.until, |state| state.connected.then_some(state.connections), "")?;
            let begun = self.shared.wait(earlier(BEGUN_WITHIN, task.until), |state| {
                let cycle = state.cycles.get(&watch)?;
                if cycle.begun || cycle.outcome.is_some() {
                    return Some(true);
                }
                (state.connections != connection || !state.connected).then_some(false)
            })?;
            match begun {
                Some(true) => break,
                Some(false) => {}
                None if task.until.is_some_and(|until| Instant::now() >= until) => return Err(timed_out()),
                None => {
                    let vanished = |cycle: &mut Cycle| cycle.outcome = Some(Outcome::Vanished);
                    self.shared.change(|state| state.cycles.get_mut(&watch).map(vanished));
                    return Ok(());
                }
            }
        }
        let over = |state: &mut State| state.cycles.get(&watch).and_then(|cycle| cycle.outcome);
        self.shared.wait(task.until, over)?.map(drop).ok_or_else(timed_out)
    }

    // --- setting up ---

    fn prepare(&self, target: &Target, memory: &mut Memory, until: Option<Instant>) -> Result<()> {
        match target {
            Target::Scan { region: None, shape: None, .. } => Ok(()),
            Target::Scan { region, shape, drifts } => {
                let wanted = ScanParameters { region: *region, shape: *shape };
                let now = self.shared.lock().view.scan_parameters;
                // in sample coordinates the tip position of a region changes with time
                let is_fixed = !drifts || region.is_none();
                let is_rounded = now.is_some_and(|now| memory.rounded == Some((wanted, now)));
                if is_fixed && (is_rounded || is_set(&wanted, now, SAME)) {
                    return Ok(());
                }
                self.set_frame(&wanted, until)?;
                // a controller may round: this is the requested value after rounding
                let now = self.shared.lock().view.scan_parameters;
                memory.rounded = now.filter(|_| is_set(&wanted, now, 1e-2)).map(|now| (wanted, now));
                Ok(())
            }
            Target::Spectrum { at_m, kind, .. } => {
                if let Some(kind) = kind {
                    let object = wire::parameter("x-spec-kind", Some(kind), None);
                    self.ask(ControlRequest::ReqParam, "the kind of the spectrum", &object, until)?;
                }
                match at_m {
                    Some(xy_m) if self.shared.lock().view.probe_m != Some(*xy_m) => {
                        let object = wire::position(*xy_m);
                        self.set_and_settle(ControlRequest::ReqSetProbePos, &object, |counts| counts.probe, until)
                    }
                    _ => Ok(()),
                }
            }
        }
    }

    fn set_frame(&self, wanted: &ScanParameters, until: Option<Instant>) -> Result<()> {
        let object = wire::scan_parameters(wanted);
        self.set_and_settle(ControlRequest::ReqSetScanParams, &object, |counts| counts.scan_parameters, until)
    }

    /// Change a setting, and wait until it is published and the tip has stopped moving.
    ///
    /// The wait is short, since a setting that changed nothing is not published.
    fn set_and_settle(
        &self,
        kind: ControlRequest,
        object: &[u8],
        count: fn(&Counts) -> u64,
        until: Option<Instant>,
    ) -> Result<()> {
        let before = count(&self.counts());
        self.ask(kind, kind.as_str_name(), object, until)?;
        let published = |state: &mut State| (count(&state.view.counts) != before).then_some(());
        if self.shared.wait(earlier(SETTLED_WITHIN, until), published)?.is_some() {
            self.shared.wait(until, |state| (state.view.scope_state() != ScopeState::SsMoving).then_some(()))?;
        }
        Ok(())
    }

    // --- commands, repeated until they are answered ---

    /// Repeat a request until it succeeds; after a loss of control this waits for control.
    fn ask(&self, kind: ControlRequest, what: &str, object: &[u8], until: Option<Instant>) -> Result<()> {
        let mut id = self.next_id();
        loop {
            if self.shared.lock().hold.is_wanted() {
                self.regain(until)?;
            }
            let counts = self.counts();
            let response = self.send(kind, object, &id, until, None)?;
            if response.is_success() {
                return Ok(());
            }
            if response.response != NO_RESPONSE {
                if !self.shared.lock().hold.is_wanted() {
                    return Err(refused(what, response));
                }
                self.get_over(what, response, counts, until)?;
                id = self.next_id();
            }
        }
    }

    /// Send a request and repeat it with the same id while the microscope is silent, so that it is executed once.
    ///
    /// A watched cycle that has started counts as an answer.
    /// REP_NO_RESPONSE is returned only if control was lost before an answer arrived.
    fn send(
        &self,
        kind: ControlRequest,
        object: &[u8],
        id: &str,
        until: Option<Instant>,
        watch: Option<u64>,
    ) -> Result<Response> {
        let give_up = earlier(PATIENCE, until);
        self.shared.wait(give_up, |state| state.view.scope.map(drop))?; // a microscope without a published state is starting
        let mut is_repeated = false;
        loop {
            let response = self.request_as(id, kind as u8, object, until)?;
            if response.detail == 3 {
                return Err(Error::Ended);
            }
            if is_repeated && NOT_IN_CONTROL.contains(&response.response) {
                // now; the outcome of the earlier attempt is still unknown
                self.shared.change(|state| state.hold.lost(&response.reason));
                return Ok(Response { response: NO_RESPONSE, ..response });
            }
            let was_lost = |state: &State| state.hold.is_wanted() && !state.hold.held;
            if !is_silent(&response) || was_lost(&self.shared.lock()) {
                return Ok(response);
            }
            if watch.is_some_and(|watch| self.is_begun(watch)) {
                return Ok(Response::default());
            }
            if give_up.is_some_and(|moment| Instant::now() >= moment) {
                return Err(refused(kind.as_str_name(), response));
            }
            is_repeated = true;
            let before = self.counts();
            let news = |state: &mut State| (state.view.counts != before).then_some(());
            self.shared.wait(earlier(RETRY, give_up), news)?;
        }
    }

    /// Wait until the cause of an unsuccessful response is gone, or return it as an error.
    fn get_over(&self, what: &str, response: Response, before: Counts, until: Option<Instant>) -> Result<()> {
        if is_silent(&response) {
            return Ok(()); // control is lost; the next attempt waits for it
        }
        if NOT_IN_CONTROL.contains(&response.response) {
            self.shared.change(|state| state.hold.lost(&response.reason));
            return Ok(());
        }
        if response.response != NOT_FREE {
            return Err(refused(what, response));
        }
        self.shared.wait(earlier(ASK_FREE_AGAIN, until), |state| {
            let is_free = state.view.scope_state() == ScopeState::SsFree && state.view.counts.scope != before.scope;
            is_free.then_some(())
        })?;
        if until.is_some_and(|until| Instant::now() >= until) {
            return Err(refused(what, response));
        }
        Ok(())
    }

    // --- looks ---

    /// Wait for a condition; return an error with `what` if it does not hold until `until`.
    fn waited<T>(&self, until: Option<Instant>, look: impl FnMut(&mut State) -> Option<T>, what: &str) -> Result<T> {
        let what = if what.is_empty() { "the scheduler does not answer" } else { what };
        self.shared.wait(until, look)?.ok_or_else(|| Error::TimedOut(what.into()))
    }

    fn wait_if_begun(&self, watch: u64, until: Option<Instant>) -> Result<()> {
        let over = |state: &mut State| {
            let cycle = state.cycles.get(&watch)?;
            (!cycle.begun || cycle.outcome.is_some()).then_some(())
        };
        self.shared.wait(until, over).map(drop)
    }

    fn counts(&self) -> Counts {
        self.shared.lock().view.counts
    }

    fn outcome(&self, watch: u64) -> Option<Outcome> {
        self.shared.lock().cycles.get(&watch).and_then(|cycle| cycle.outcome)
    }

    fn is_begun(&self, watch: u64) -> bool {
        self.shared.lock().cycles.get(&watch).is_some_and(|cycle| cycle.begun)
    }

    fn results(&self, watch: u64) -> Vec<Arc<Packet>> {
        self.shared.lock().cycles.get(&watch).map_or(Vec::new(), |cycle| cycle.results.clone())
    }

    fn drop_watch(&self, task: &mut Task) {
        if let Some(watch) = task.watch.take() {
            self.shared.lock().cycles.remove(&watch);
        }
    }
}

/// Return whether the outcome of a request is unknown.
fn is_silent(response: &Response) -> bool {
    response.response == NO_RESPONSE || !response.is_success() && matches!(response.detail, 1 | 2)
}

/// A restarted translator may publish a channel twice: the newest counts.
fn newest_of_each(packets: Vec<Arc<Packet>>) -> Vec<Arc<Packet>> {
    let mut found: Vec<Arc<Packet>> = Vec::new();
    let channel = |packet: &Packet| packet.scan().map(|scan| scan.channel.clone());
    for packet in packets {
        match found.iter_mut().find(|earlier| channel(earlier) == channel(&packet)) {
            Some(earlier) => *earlier = packet,
            None => found.push(packet),
        }
    }
    found
}

/// Return whether the parameters in force match the wanted ones within `tolerance` of the size.
fn is_set(wanted: &ScanParameters, now: Option<ScanParameters>, tolerance: f64) -> bool {
    let Some(now) = now else { return false };
    let has_region = |region: Region| now.region.is_some_and(|now| region.is_near(&now, tolerance));
    wanted.shape.is_none_or(|shape| now.shape == Some(shape)) && wanted.region.is_none_or(has_region)
}
