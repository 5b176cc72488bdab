//! The thread that owns the sockets: it sends the program's requests, and processes received messages.

use std::collections::HashMap;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use libsodium_sys as sodium;

use crate::error::{Error, Result};
use crate::launch::Launch;
use crate::shared::Shared;
use crate::wire::{self, Response};
use crate::zmq::{self, Context, Frame, Socket};

const QUEUE: i32 = 4000;
const LINGER_MS: i32 = 200;
const MOST_PACKET_BYTES: i64 = 256 << 20;
const MOST_REQUEST_BYTES: i64 = 1 << 20;
const MOST_ENVELOPES: usize = 10_000;
const BATCH: usize = 16;
/// Prefixes that `Client` itself needs, in addition to the component's.
const FOLLOWED: [&str; 7] =
    ["ScopeStateMsg", "ControlState", "ScanParameters2d", "ZCtrlParameters", "ProbePosition", "Scan2d", "Spec1d"];

/// Return a socket with the options of all sockets.
fn socket(context: &Context, kind: i32, most_bytes: i64) -> Result<Socket> {
    let socket = context.socket(kind)?;
    let beats: &[(i32, i32)] = if kind == zmq::DEALER {
        // libzmq aborts over its heartbeats after a bounded receive queue was full: so the queue is unbounded
        &[(zmq::HEARTBEAT_IVL, 2000), (zmq::HEARTBEAT_TIMEOUT, 8000), (zmq::HEARTBEAT_TTL, 8000), (zmq::RCVHWM, 0)]
    } else {
        &[(zmq::RCVHWM, QUEUE)]
    };
    let all: &[(i32, i32)] = &[
        (zmq::LINGER, LINGER_MS),
        (zmq::SNDHWM, QUEUE),
        (zmq::TCP_KEEPALIVE, 1),
        (zmq::TCP_KEEPALIVE_IDLE, 2),
        (zmq::TCP_KEEPALIVE_INTVL, 2),
        (zmq::TCP_KEEPALIVE_CNT, 3),
        (zmq::RECONNECT_IVL, 20),
        (zmq::RECONNECT_IVL_MAX, 200),
        (zmq::HANDSHAKE_IVL, 5000),
        #[cfg(not(windows))] // Wine does not have it, and libzmq then never connects
        (zmq::TCP_MAXRT, 5000),
    ];
    for (option, value) in all.iter().chain(beats) {
        socket.set(*option, *value)?;
    }
    socket.set_long(zmq::MAXMSGSIZE, most_bytes)?;
    Ok(socket)
}

/// Connect with the keys of the launch line; without keys only to this computer, unless the experiment is `insecure`.
fn connect(socket: &Socket, launch: &Launch, address: &str) -> Result<()> {
    if let Some(keys) = &launch.keys {
        if let Some(server) = keys.server_key(address)? {
            socket.set_bytes(zmq::CURVE_SERVERKEY, server.as_bytes())?;
            socket.set_bytes(zmq::CURVE_PUBLICKEY, keys.public.as_bytes())?;
            socket.set_bytes(zmq::CURVE_SECRETKEY, keys.secret.as_bytes())?;
            return socket.connect(address);
        }
    }
    if !launch.insecure && !is_local(address) {
        return Err(Error::Config(format!("{address}: it is on another computer, and there are no keys")));
    }
    socket.connect(address)
}

/// Connect to this computer: with keys where the launch line has the server's.
pub fn connect_here(socket: &Socket, launch: &Launch, address: &str) -> Result<()> {
    match &launch.keys {
        Some(keys) if keys.servers.contains_key(address) => connect(socket, launch, address),
        _ => socket.connect(address),
    }
}

fn is_local(address: &str) -> bool {
    let Some((scheme, rest)) = address.split_once("://") else { return false };
    let host = rest.rsplit_once(':').map_or(rest, |(host, _)| host).trim_matches(['[', ']']);
    let is_loopback = host.parse::<std::net::IpAddr>().is_ok_and(|host| host.is_loopback());
    matches!(scheme, "ipc" | "inproc") || scheme == "tcp" && (host == "localhost" || is_loopback)
}

/// Return the identity of the component's socket: the same in every life, and secret if there are keys.
fn routing_id(launch: &Launch) -> Vec<u8> {
    let mut id = launch.name.clone().into_bytes();
    let Some(keys) = &launch.keys else { return id };
    let mut digest = [0_u8; 32];
    // SAFETY: libsodium fills the structure and the 32 bytes
    unsafe {
        let mut state = std::mem::zeroed();
        sodium::crypto_auth_hmacsha256_init(&mut state, keys.secret.as_ptr(), keys.secret.len());
        sodium::crypto_auth_hmacsha256_update(&mut state, launch.name.as_ptr(), launch.name.len() as u64);
        sodium::crypto_auth_hmacsha256_final(&mut state, digest.as_mut_ptr());
    }
    id.push(0);
    id.extend(digest[..8].iter().flat_map(|byte| format!("{byte:02x}").into_bytes()));
    id
}

/// Return random digits that distinguish two lives of a component.
pub fn new_life() -> String {
    let mut bytes = [0_u8; 4];
    // SAFETY: the length is that of the buffer; libsodium may be initialised more than once
    unsafe {
        sodium::sodium_init();
        sodium::randombytes_buf(bytes.as_mut_ptr().cast(), bytes.len());
    }
    format!("{:08x}", u32::from_ne_bytes(bytes))
}

/// A pair of sockets with which threads wake the waiting one.
pub fn waker(context: &Context) -> Result<(Socket, Socket)> {
    let (waits, wakes) = (context.socket(zmq::PULL)?, context.socket(zmq::PUSH)?);
    waits.bind("inproc://wake")?;
    wakes.connect("inproc://wake")?;
    wakes.set(zmq::LINGER, 0)?;
    Ok((waits, wakes))
}

/// Open all sockets of the launch line, and start to serve them.
pub fn start(context: &Context, waits: Socket, shared: &Arc<Shared>) -> Result<JoinHandle<()>> {
    let launch = &shared.launch;
    let control = launch.sockets.control.as_ref().map(|address| Control::new(context, shared, address)).transpose()?;
    let subscribers = launch.sockets.subscribe.iter().enumerate();
    let subscribers =
        subscribers.map(|(i, address)| Subscriber::new(context, launch, address, i == 0)).collect::<Result<_>>()?;
    let sockets = Sockets { shared: shared.clone(), waits, control, subscribers };
    Ok(thread::spawn(move || sockets.run()))
}

struct Sockets {
    shared: Arc<Shared>,
    waits: Socket,
    control: Option<Control>,
    subscribers: Vec<Subscriber>,
}

impl Sockets {
    fn run(mut self) {
        while !self.shared.lock().closing {
            self.wait();
            while self.waits.receive().is_some() {}
            if let Some(control) = &mut self.control {
                control.serve();
            }
            for subscriber in &mut self.subscribers {
                subscriber.serve(&self.shared);
            }
            if let Some(control) = &mut self.control {
                control.give_back_inherited();
            }
        }
        if let Some(control) = &mut self.control {
            control.send_all();
        }
    }

    fn wait(&self) {
        let mut all = vec![&self.waits];
        all.extend(self.control.iter().flat_map(|control| [&control.socket, &control.monitor]));
        all.extend(self.subscribers.iter().flat_map(|subscriber| [&subscriber.socket, &subscriber.monitor]));
        zmq::poll(&all, None);
    }
}

fn warn(text: &str) {
    eprintln!("WARNING afspm: {text}");
}

// --- requests ---

type Frames = Vec<Vec<u8>>;

/// The connection to the scheduler: the bytes of a REQ socket, without its lock step.
struct Control {
    shared: Arc<Shared>,
    socket: Socket,
    monitor: Socket,
    address: String,
    connected: bool,
    /// Whether the scheduler has answered.
    known: bool,
    /// The id of the last request while it is unanswered.
    unanswered: Vec<u8>,
    greetings: u64,
}

impl Control {
    fn new(context: &Context, shared: &Arc<Shared>, address: &str) -> Result<Control> {
        let socket = socket(context, zmq::DEALER, MOST_REQUEST_BYTES)?;
        socket.set_bytes(zmq::ROUTING_ID, &routing_id(&shared.launch))?;
        let monitor = socket.monitor(zmq::CONNECTED | zmq::DISCONNECTED)?;
        connect(&socket, &shared.launch, address)?;
        let (shared, address) = (shared.clone(), address.to_owned());
        Ok(Control {
            shared,
            socket,
            monitor,
            address,
            connected: false,
            known: false,
            unanswered: Vec::new(),
            greetings: 0,
        })
    }

    fn serve(&mut self) {
        while let Some(event) = self.monitor.event() {
            self.connection(event == zmq::CONNECTED);
        }
        while let Some(frames) = self.socket.receive() {
            self.take(&frames);
        }
        self.send_all();
    }

    fn send_all(&mut self) {
        let outbox = std::mem::take(&mut self.shared.lock().outbox);
        for frames in outbox {
            self.ask(frames);
        }
    }

    /// Release once the control of an earlier life, for which other components wait.
    fn give_back_inherited(&mut self) {
        let name = &self.shared.launch.name;
        let mut state = self.shared.lock();
        if !(self.known
            && self.connected
            && state.gives_back
            && state.hold.tenures == 0
            && state.inherits_control(name))
        {
            return;
        }
        state.gives_back = false;
        drop(state);
        let id = format!("{name}/{}/{}", self.shared.session, u32::MAX - 1);
        self.ask(wire::request(crate::proto::ControlRequest::ReqReleaseCtrl as u8, b"", &id));
    }

    /// Follow the scheduler's connection; announce the run of this client by the id of a request.
    fn connection(&mut self, connected: bool) {
        self.connected = connected;
        self.unanswered.clear();
        if connected {
            self.greetings += 1;
            let id = format!("{}/{}/{}", self.shared.launch.name, self.shared.session, 1_000_000_000 + self.greetings);
            self.ask(wire::request(wire::CLOCK, b"", &id));
        }
        self.shared.change(|state| {
            state.connected = connected;
            state.connections += u64::from(connected);
        });
    }

    /// Send a request; dropped while there is no connection.
    ///
    /// A request repeated without an answer in between replaces the connection: one that is established but without
    /// answers would never recover.
    fn ask(&mut self, frames: Frames) {
        if !self.connected {
            return;
        }
        if self.unanswered == frames[2] {
            self.reconnect();
        } else {
            self.unanswered.clone_from(&frames[2]);
            self.send(&frames);
        }
    }

    fn send(&mut self, frames: &Frames) {
        let mut all = vec![Vec::new()];
        all.extend(frames.iter().cloned());
        if self.socket.send(&all) && frames.len() > 2 {
            let id = String::from_utf8_lossy(&frames[2]);
            if let Some(pending) = self.shared.lock().pending.get_mut(&*id) {
                pending.sent = true;
            }
        }
    }

    fn reconnect(&mut self) {
        self.connected = false;
        self.unanswered.clear();
        let again = self.socket.disconnect(&self.address).and_then(|()| self.socket.connect(&self.address));
        if let Err(error) = again {
            warn(&error.to_string());
        }
        self.shared.change(|state| state.connected = false);
    }

    fn take(&mut self, frames: &[Frame]) {
        if frames.len() < 2 || !frames[0].is_empty() {
            return; // an empty frame alone: the scheduler's probe whether this client is alive
        }
        match wire::response(&frames[1..]) {
            Ok(answer) => self.answer(answer),
            Err(error) => warn(&format!("dropped a reply: {error}")),
        }
    }

    fn answer(&mut self, answer: Response) {
        self.known = true;
        self.unanswered.clear();
        if answer.response == wire::OTHER_RUN {
            self.shared.finish(Error::Config(answer.reason.clone()));
        }
        self.shared.change(|state| {
            if let Some(pending) = state.pending.get_mut(&answer.id) {
                pending.answer = Some(answer);
            }
        });
    }
}

// --- packets ---

/// A connection to one publisher: receives each packet once, and missed packets before newer ones.
struct Subscriber {
    socket: Socket,
    monitor: Socket,
    /// Of the scheduler.
    is_ours: bool,
    name: String,
    prefixes: Vec<String>,
    /// Prefixes of the component itself.
    wanted: Option<Vec<String>>,
    newest_ns: i64,
    newest_of: HashMap<String, i64>,
    nonce: u64,
    marker: Vec<u8>,
    topic: Vec<u8>,
}

impl Subscriber {
    fn new(context: &Context, launch: &Launch, address: &str, is_ours: bool) -> Result<Subscriber> {
        let prefixes = match &launch.envelopes {
            Some(wanted) if !wanted.iter().any(String::is_empty) => {
                let all = wanted.iter().map(String::as_str).chain(FOLLOWED).chain(["KILL"]);
                all.map(str::to_owned).collect()
            }
            _ => vec![String::new()],
        };
        // unlike SUB, XSUB receives packets of any topic, and sends the marker unchanged
        let socket = socket(context, zmq::XSUB, MOST_PACKET_BYTES)?;
        let monitor = socket.monitor(zmq::CONNECTED)?;
        for prefix in &prefixes {
            socket.send(&[[&b"\x01"[..], prefix.as_bytes()].concat()]);
        }
        connect(&socket, launch, address)?;
        Ok(Subscriber {
            socket,
            monitor,
            is_ours,
            name: launch.name.replace('\0', ""),
            prefixes,
            wanted: launch.envelopes.clone(),
            newest_ns: -1,
            newest_of: HashMap::new(),
            nonce: 0,
            marker: Vec::new(),
            topic: Vec::new(),
        })
    }

    fn serve(&mut self, shared: &Shared) {
        let mut is_new = false;
        while self.monitor.event().is_some() {
            is_new = true;
        }
        if is_new {
            self.ask_for_missed();
        }
        for _ in 0..BATCH {
            let Some(frames) = self.socket.receive() else { return };
            self.take(frames, shared);
        }
    }

    /// Request the packets newer than the newest received one, for this subscriber alone.
    fn ask_for_missed(&mut self) {
        self.forget_marker();
        self.topic = format!("\0replay/{}/{}", self.name, self.nonce).into_bytes();
        self.nonce += 1;
        self.marker = self.topic.clone();
        self.marker.extend(format!("\0{}", self.newest_ns).bytes());
        self.marker.extend(self.prefixes.iter().flat_map(|prefix| format!("\0{prefix}").into_bytes()));
        self.socket.send(&[[&b"\x01"[..], &self.marker].concat()]);
    }

    /// Unsubscribe: otherwise the socket would repeat the request at its next connection.
    fn forget_marker(&mut self) {
        if !self.marker.is_empty() {
            self.socket.send(&[[&b"\x00"[..], &self.marker].concat()]);
            self.marker.clear();
        }
    }

    fn take(&mut self, mut frames: Vec<Frame>, shared: &Shared) {
        if frames[0].first() == Some(&0) {
            if self.marker.is_empty() || *frames[0] != *self.topic {
                return; // of an earlier connection
            }
            frames.remove(0);
            if frames.is_empty() {
                self.forget_marker();
                return shared.change(|state| state.caught_up |= self.is_ours);
            }
        } else if frames.len() == 1 && *frames[0] == *wire::KILL {
            return shared.finish(Error::Ended);
        }
        match wire::packet(frames) {
            Ok(packet) if self.is_new(&packet.envelope, packet.time_ns) => {
                let wanted = self.is_wanted(&packet.envelope);
                shared.change(|state| state.take(packet, self.is_ours, wanted, &self.name));
            }
            Ok(_) => {}
            Err(error) => warn(&format!("dropped a packet: {error}")),
        }
    }

    fn is_wanted(&self, envelope: &str) -> bool {
        let Some(wanted) = &self.wanted else { return true };
        wanted.iter().any(|prefix| envelope.starts_with(prefix))
    }

    fn is_new(&mut self, envelope: &str, time_ns: Option<i64>) -> bool {
        let Some(time_ns) = time_ns else { return true };
        if self.newest_of.get(envelope).is_some_and(|newest_ns| time_ns <= *newest_ns) {
            return false;
        }
        if self.newest_of.len() >= MOST_ENVELOPES {
            self.newest_of.clear();
        }
        self.newest_of.insert(envelope.to_owned(), time_ns);
        self.newest_ns = self.newest_ns.max(time_ns);
        true
    }
}
