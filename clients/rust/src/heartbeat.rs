//! Heartbeats from a separate thread, so that a busy process does not count as dead.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crate::error::Result;
use crate::launch::Launch;
use crate::sockets;
use crate::zmq::{self, Context, Socket};

/// The age of the current step, which distinguishes a busy process from a frozen one.
pub struct Activity {
    zero: Instant,
    since_ms: AtomicU64,
    waiting: AtomicUsize,
    longest_ms: AtomicU64,
}

impl Activity {
    pub fn new() -> Activity {
        Activity {
            zero: Instant::now(),
            since_ms: AtomicU64::new(0),
            waiting: AtomicUsize::new(0),
            longest_ms: AtomicU64::new(30_000),
        }
    }

    fn now_ms(&self) -> u64 {
        self.zero.elapsed().as_millis() as u64
    }

    /// Set the longest step between two calls of the library.
    pub fn allow(&self, longest: Duration) {
        self.longest_ms.store(longest.as_millis() as u64, Ordering::Relaxed);
    }

    /// Mark this thread as waiting until the returned guard is dropped.
    pub fn wait(&self) -> Waiting<'_> {
        self.waiting.fetch_add(1, Ordering::SeqCst);
        Waiting(self)
    }

    fn age_ms(&self) -> u64 {
        if self.waiting.load(Ordering::SeqCst) > 0 {
            return 0;
        }
        self.now_ms().saturating_sub(self.since_ms.load(Ordering::SeqCst))
    }
}

pub struct Waiting<'a>(&'a Activity);

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.since_ms.store(self.0.now_ms(), Ordering::SeqCst);
        self.0.waiting.fetch_sub(1, Ordering::SeqCst);
    }
}

type Stop = Arc<(Mutex<bool>, Condvar)>;

/// Sends beats until it is dropped; the last one is the closing beat.
pub struct Heartbeat {
    stop: Stop,
    thread: Option<JoinHandle<()>>,
}

impl Heartbeat {
    /// Start the beats if the launch line names a listener.
    pub fn start(launch: &Launch, activity: &Arc<Activity>) -> Result<Option<Heartbeat>> {
        let Some(address) = &launch.sockets.heartbeat else { return Ok(None) };
        let socket = Context::new()?.socket(zmq::XPUB)?;
        socket.set(zmq::LINGER, 200)?;
        sockets::connect_here(&socket, launch, address)?;
        let stop = Stop::default();
        let beats = Beats {
            socket,
            token: launch.beat_token.clone().into_bytes(),
            period: Duration::from_secs_f64(launch.beat_period_s.clamp(0.01, 3600.0)),
            activity: activity.clone(),
        };
        let told = stop.clone();
        let thread = Some(thread::spawn(move || beats.run(&told)));
        Ok(Some(Heartbeat { stop, thread }))
    }
}

impl Drop for Heartbeat {
    fn drop(&mut self) {
        *self.stop.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.stop.1.notify_all();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Beats {
    socket: Socket,
    token: Vec<u8>,
    period: Duration,
    activity: Arc<Activity>,
}

impl Beats {
    fn run(self, stop: &(Mutex<bool>, Condvar)) {
        // a beat before the listener has subscribed would be lost
        zmq::poll(&[&self.socket], Some(self.period));
        while !self.is_stopped(stop) {
            self.send(0);
        }
        self.send(1);
    }

    /// Wait for a period, but not before the first beat.
    fn is_stopped(&self, stop: &(Mutex<bool>, Condvar)) -> bool {
        let first = self.socket.receive().is_some();
        let stopped = stop.0.lock().unwrap_or_else(PoisonError::into_inner);
        if first || *stopped {
            return *stopped;
        }
        let waited = stop.1.wait_timeout_while(stopped, self.period, |stopped| !*stopped);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }

    fn send(&self, beat: u8) {
        let seconds = |ms: u64| format!("{:.3}", ms as f64 / 1000.0).into_bytes();
        let longest = self.activity.longest_ms.load(Ordering::Relaxed);
        self.socket.send(&[vec![beat], seconds(self.activity.age_ms()), seconds(longest), self.token.clone()]);
    }
}
