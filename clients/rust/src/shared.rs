//! The state shared by the thread that owns the sockets and the program's threads, and the only way to wait for it.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::cycle::Cycle;
use crate::error::{Error, Result};
use crate::heartbeat::Activity;
use crate::launch::Launch;
use crate::model::{ControlStatus, Feedback, Message, Packet, ScanParameters, ScopeStatus};
use crate::proto::{ControlMode, ScopeState};
use crate::wire::Response;
use crate::zmq::Socket;

/// Largest queue of `Client::next`, in bytes and packets; beyond it the oldest are dropped.
const MOST_BYTES: usize = 256 << 20;
const MOST_PACKETS: usize = 10_000;

/// The newest published states, and how often each was published.
#[derive(Default)]
pub struct View {
    pub scope: Option<ScopeStatus>,
    pub control: Option<ControlStatus>,
    pub scan_parameters: Option<ScanParameters>,
    pub feedback: Option<Feedback>,
    pub probe_m: Option<[f64; 2]>,
    pub newest_ns: Option<i64>,
    pub counts: Counts,
}

/// How often states were published.
#[derive(Default, Clone, Copy, PartialEq, Eq)]
pub struct Counts {
    pub scope: u64,
    pub control: u64,
    pub scan_parameters: u64,
    pub feedback: u64,
    pub probe: u64,
}

impl View {
    pub fn scope_state(&self) -> ScopeState {
        self.scope.map_or(ScopeState::SsUndefined, |status| status.state)
    }

    pub fn is_flagged(&self, problem: u8) -> bool {
        self.control.as_ref().is_some_and(|control| control.problems.contains(&problem))
    }

    fn take(&mut self, packet: &Packet) {
        self.newest_ns = self.newest_ns.max(packet.time_ns);
        match &packet.message {
            Message::Scope(status) => (self.scope, self.counts.scope) = (Some(*status), self.counts.scope + 1),
            Message::Control(control) => {
                (self.control, self.counts.control) = (Some(control.clone()), self.counts.control + 1);
            }
            Message::ScanParameters(now) => {
                (self.scan_parameters, self.counts.scan_parameters) = (Some(*now), self.counts.scan_parameters + 1);
            }
            Message::Feedback(now) => (self.feedback, self.counts.feedback) = (Some(*now), self.counts.feedback + 1),
            Message::ProbePosition(now) => (self.probe_m, self.counts.probe) = (Some(*now), self.counts.probe + 1),
            _ => {}
        }
    }
}

/// The component's hold on control.
///
/// Answers of the scheduler grant control; its published state revokes it, once a state has named this component:
/// a state from before the grant may still be in transit.
#[derive(Default)]
pub struct Hold {
    /// Number of measurements that want control.
    pub users: usize,
    /// The program wants control, to solve this problem; 0 for none.
    pub asked: Option<u8>,
    pub held: bool,
    pub was_named: bool,
    /// Number of grants of control.
    pub tenures: u64,
    pub why_lost: String,
}

impl Hold {
    pub fn is_wanted(&self) -> bool {
        self.users > 0 || self.asked.is_some()
    }

    /// Return the problem for which control is wanted; 0 for none.
    pub fn solving(&self) -> u8 {
        self.asked.unwrap_or(0)
    }

    pub fn lost(&mut self, why: &str) {
        self.held = false;
        self.why_lost = why.to_owned();
    }
}

/// The request whose answer is awaited.
#[derive(Default)]
pub struct Pending {
    pub answer: Option<Response>,
    /// Whether it was sent at least once.
    pub sent: bool,
}

#[derive(Default)]
pub struct State {
    pub connected: bool,
    pub connections: u64,
    pub caught_up: bool,
    /// Frames of requests, to be sent by the thread that owns the sockets.
    pub outbox: Vec<Vec<Vec<u8>>>,
    pub pending: HashMap<String, Pending>,
    pub view: View,
    pub hold: Hold,
    pub cycles: BTreeMap<u64, Cycle>,
    pub lines: VecDeque<String>,
    pub over: Option<Error>,
    pub closing: bool,
    /// Whether to release the control held by an earlier life: no measurement is resumed with it.
    pub gives_back: bool,
    backlog: VecDeque<Arc<Packet>>,
    backlog_bytes: usize,
    dropped: u64,
}

impl State {
    /// Process a packet of a publisher; `ours`: the scheduler sent it.
    pub fn take(&mut self, packet: Packet, ours: bool, wanted: bool, name: &str) {
        let packet = Arc::new(packet);
        if ours {
            self.view.take(&packet);
            if let Message::Control(control) = &packet.message {
                self.follow_control(control.holder.as_deref() == Some(name));
            }
            for cycle in self.cycles.values_mut() {
                cycle.take(&packet);
            }
        }
        if wanted {
            self.backlog_bytes += packet.size();
            self.backlog.push_back(packet);
            while self.backlog_bytes > MOST_BYTES && self.backlog.len() > 1 || self.backlog.len() > MOST_PACKETS {
                self.backlog_bytes -= self.backlog.pop_front().map_or(0, |oldest| oldest.size());
                self.dropped += 1;
            }
        }
    }

    fn follow_control(&mut self, is_ours: bool) {
        if self.hold.held && is_ours {
            self.hold.was_named = true;
        } else if self.hold.held && self.hold.was_named {
            let why = self.obstacle(self.hold.solving(), "");
            self.hold.lost(if why.is_empty() { "it was revoked" } else { &why });
        }
    }

    /// Return whether the scheduler still counts an earlier life of this component as the holder of control.
    pub fn inherits_control(&self, name: &str) -> bool {
        let is_holder = self.view.control.as_ref().is_some_and(|control| control.holder.as_deref() == Some(name));
        is_holder && !self.hold.held && !self.hold.is_wanted()
    }

    /// Return the oldest waiting packet whose envelope begins with `prefix`.
    pub fn next_packet(&mut self, prefix: &str) -> Option<Arc<Packet>> {
        let index = self.backlog.iter().position(|packet| packet.envelope.starts_with(prefix))?;
        let packet = self.backlog.remove(index)?;
        self.backlog_bytes -= packet.size();
        Some(packet)
    }

    /// Return the number of packets dropped since the last call.
    pub fn take_dropped(&mut self) -> u64 {
        std::mem::take(&mut self.dropped)
    }

    /// Return the reason why control is withheld, for a person; empty without one.
    pub fn obstacle(&self, solving: u8, name: &str) -> String {
        let Some(control) = &self.view.control else { return String::new() };
        let flagged =
            || control.problems.iter().map(|number| format!("problem {number}")).collect::<Vec<_>>().join(", ");
        if control.mode == ControlMode::CmManual {
            "the mode is MANUAL".into()
        } else if solving == 0 && !control.problems.is_empty() {
            format!("{} flagged", flagged())
        } else if solving != 0 && !control.problems.contains(&solving) {
            format!("problem {solving} is not flagged")
        } else {
            match &control.holder {
                Some(holder) if holder != name => format!("{holder} is in control"),
                _ => String::new(),
            }
        }
    }
}

pub struct Shared {
    pub launch: Launch,
    /// The life of the component in its request ids: "<run>-<random>".
    pub session: String,
    pub activity: Arc<Activity>,
    state: Mutex<State>,
    changed: Condvar,
    waker: Mutex<Socket>,
}

impl Shared {
    pub fn new(launch: Launch, session: String, waker: Socket) -> Shared {
        Shared {
            launch,
            session,
            activity: Arc::new(Activity::new()),
            state: Mutex::default(),
            changed: Condvar::new(),
            waker: Mutex::new(waker),
        }
    }

    pub fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Change the state, and wake all waiting threads.
    pub fn change<T>(&self, change: impl FnOnce(&mut State) -> T) -> T {
        let result = change(&mut self.lock());
        self.changed.notify_all();
        result
    }

    /// Return `why` from every waiting call and all later ones.
    pub fn finish(&self, why: Error) {
        self.change(|state| state.over = state.over.take().or(Some(why)));
    }

    /// Wake the thread that owns the sockets.
    pub fn wake(&self) {
        self.waker.lock().unwrap_or_else(PoisonError::into_inner).send(&[b""]);
    }

    /// Wait until `look` finds something; None if `until` comes first.
    pub fn wait<T>(&self, until: Option<Instant>, mut look: impl FnMut(&mut State) -> Option<T>) -> Result<Option<T>> {
        let _waiting = self.activity.wait();
        let mut state = self.lock();
        loop {
            if let Some(over) = &state.over {
                return Err(over.clone());
            }
            if let Some(found) = look(&mut state) {
                return Ok(Some(found));
            }
            let Some(until) = until else {
                state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// Return the end of a timeout, or `until` if that comes first.
pub fn earlier(timeout: Duration, until: Option<Instant>) -> Option<Instant> {
    let soon = Instant::now() + timeout;
    Some(until.map_or(soon, |until| until.min(soon)))
}
