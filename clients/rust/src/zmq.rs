//! The few functions of libzmq that a client needs, made safe: contexts, sockets, messages, polling.
//!
//! Written by hand: the `zmq` crate's libzmq is built without CURVE (rust-zmq#357).

use std::ffi::{c_char, c_int, c_long, c_short, c_void, CStr, CString};
use std::ops::Deref;
use std::sync::Arc;
use std::time::Duration;

use crate::error::{Error, Result};

/// Memory for a `zmq_msg_t`, with the size and alignment that libzmq guarantees.
#[repr(C, align(8))]
struct RawMessage([u8; 64]);

#[cfg(windows)]
type Descriptor = usize;
#[cfg(not(windows))]
type Descriptor = c_int;

#[repr(C)]
struct PollItem {
    socket: *mut c_void,
    descriptor: Descriptor,
    events: c_short,
    ready: c_short,
}

extern "C" {
    fn zmq_errno() -> c_int;
    fn zmq_strerror(number: c_int) -> *const c_char;
    fn zmq_ctx_new() -> *mut c_void;
    fn zmq_ctx_term(context: *mut c_void) -> c_int;
    fn zmq_socket(context: *mut c_void, kind: c_int) -> *mut c_void;
    fn zmq_close(socket: *mut c_void) -> c_int;
    fn zmq_setsockopt(socket: *mut c_void, option: c_int, value: *const c_void, size: usize) -> c_int;
    fn zmq_bind(socket: *mut c_void, address: *const c_char) -> c_int;
    fn zmq_connect(socket: *mut c_void, address: *const c_char) -> c_int;
    fn zmq_disconnect(socket: *mut c_void, address: *const c_char) -> c_int;
    fn zmq_socket_monitor(socket: *mut c_void, address: *const c_char, events: c_int) -> c_int;
    fn zmq_send(socket: *mut c_void, data: *const c_void, size: usize, flags: c_int) -> c_int;
    fn zmq_msg_init(message: *mut RawMessage) -> c_int;
    fn zmq_msg_init_size(message: *mut RawMessage, size: usize) -> c_int;
    fn zmq_msg_recv(message: *mut RawMessage, socket: *mut c_void, flags: c_int) -> c_int;
    fn zmq_msg_more(message: *const RawMessage) -> c_int;
    fn zmq_msg_data(message: *mut RawMessage) -> *mut c_void;
    fn zmq_msg_size(message: *const RawMessage) -> usize;
    fn zmq_msg_close(message: *mut RawMessage) -> c_int;
    fn zmq_poll(items: *mut PollItem, count: c_int, timeout: c_long) -> c_int;
}

pub const PAIR: c_int = 0;
pub const DEALER: c_int = 5;
pub const PULL: c_int = 7;
pub const PUSH: c_int = 8;
pub const XPUB: c_int = 9;
pub const XSUB: c_int = 10;

pub const ROUTING_ID: c_int = 5;
pub const LINGER: c_int = 17;
pub const RECONNECT_IVL: c_int = 18;
pub const RECONNECT_IVL_MAX: c_int = 21;
pub const MAXMSGSIZE: c_int = 22;
pub const SNDHWM: c_int = 23;
pub const RCVHWM: c_int = 24;
pub const TCP_KEEPALIVE: c_int = 34;
pub const TCP_KEEPALIVE_CNT: c_int = 35;
pub const TCP_KEEPALIVE_IDLE: c_int = 36;
pub const TCP_KEEPALIVE_INTVL: c_int = 37;
pub const CURVE_PUBLICKEY: c_int = 48;
pub const CURVE_SECRETKEY: c_int = 49;
pub const CURVE_SERVERKEY: c_int = 50;
pub const HANDSHAKE_IVL: c_int = 66;
pub const HEARTBEAT_IVL: c_int = 75;
pub const HEARTBEAT_TTL: c_int = 76;
pub const HEARTBEAT_TIMEOUT: c_int = 77;
#[cfg(not(windows))]
pub const TCP_MAXRT: c_int = 80;

pub const CONNECTED: u16 = 0x1000; // the handshake succeeded
pub const DISCONNECTED: u16 = 0x0200;

const DONTWAIT: c_int = 1;
const SNDMORE: c_int = 2;
const POLLIN: c_short = 1;

fn failure(what: &str) -> Error {
    // SAFETY: zmq_strerror returns a static text for any number
    let text = unsafe { CStr::from_ptr(zmq_strerror(zmq_errno())) };
    Error::Transport(format!("{what}: {}", text.to_string_lossy()))
}

fn check(what: &str, code: c_int) -> Result<()> {
    if code < 0 {
        return Err(failure(what));
    }
    Ok(())
}

fn address(text: &str) -> Result<CString> {
    CString::new(text).map_err(|_| Error::Transport(format!("{text:?} is no address")))
}

struct RawContext(*mut c_void);
// SAFETY: libzmq's contexts may be used from any thread
unsafe impl Send for RawContext {}
unsafe impl Sync for RawContext {}

impl Drop for RawContext {
    fn drop(&mut self) {
        // SAFETY: all sockets hold the context, so that they are closed before
        unsafe { zmq_ctx_term(self.0) };
    }
}

/// A ZeroMQ context; it ends with its last socket.
#[derive(Clone)]
pub struct Context(Arc<RawContext>);

impl Context {
    pub fn new() -> Result<Context> {
        // SAFETY: no arguments
        let raw = unsafe { zmq_ctx_new() };
        if raw.is_null() {
            return Err(failure("no ZeroMQ context"));
        }
        Ok(Context(Arc::new(RawContext(raw))))
    }

    pub fn socket(&self, kind: c_int) -> Result<Socket> {
        // SAFETY: the context lives as long as the socket, which holds it
        let raw = unsafe { zmq_socket(self.0 .0, kind) };
        if raw.is_null() {
            return Err(failure("no ZeroMQ socket"));
        }
        Ok(Socket { raw, _context: self.clone() })
    }
}

/// A socket, for one thread at a time.
pub struct Socket {
    raw: *mut c_void,
    _context: Context,
}
// SAFETY: libzmq's sockets may move to another thread, with a memory barrier, which every way of moving has
unsafe impl Send for Socket {}

impl Drop for Socket {
    fn drop(&mut self) {
        // SAFETY: it is open, and not used afterwards
        unsafe { zmq_close(self.raw) };
    }
}

impl Socket {
    pub fn set(&self, option: c_int, value: i32) -> Result<()> {
        self.set_bytes(option, &value.to_ne_bytes())
    }

    pub fn set_long(&self, option: c_int, value: i64) -> Result<()> {
        self.set_bytes(option, &value.to_ne_bytes())
    }

    pub fn set_bytes(&self, option: c_int, value: &[u8]) -> Result<()> {
        // SAFETY: libzmq copies the bytes
        let code = unsafe { zmq_setsockopt(self.raw, option, value.as_ptr().cast(), value.len()) };
        check(&format!("socket option {option}"), code)
    }

    pub fn bind(&self, to: &str) -> Result<()> {
        let c_address = address(to)?;
        // SAFETY: the text ends with a zero byte
        check(&format!("{to}: can't bind"), unsafe { zmq_bind(self.raw, c_address.as_ptr()) })
    }

    pub fn connect(&self, to: &str) -> Result<()> {
        let c_address = address(to)?;
        // SAFETY: as above
        check(&format!("{to}: can't connect"), unsafe { zmq_connect(self.raw, c_address.as_ptr()) })
    }

    pub fn disconnect(&self, from: &str) -> Result<()> {
        let c_address = address(from)?;
        // SAFETY: as above
        check(&format!("{from}: can't disconnect"), unsafe { zmq_disconnect(self.raw, c_address.as_ptr()) })
    }

    /// Return a socket that receives this one's connection events.
    pub fn monitor(&self, events: u16) -> Result<Socket> {
        let name = format!("inproc://monitor-{:p}", self.raw);
        let c_address = address(&name)?;
        // SAFETY: as above
        check("monitor", unsafe { zmq_socket_monitor(self.raw, c_address.as_ptr(), c_int::from(events)) })?;
        let monitor = self._context.socket(PAIR)?;
        monitor.set(RCVHWM, 0)?;
        monitor.connect(&name)?;
        Ok(monitor)
    }

    /// Send a message of several frames; false if the queue is full.
    pub fn send<T: AsRef<[u8]>>(&self, frames: &[T]) -> bool {
        frames.iter().enumerate().all(|(i, frame)| {
            let bytes = frame.as_ref();
            let flags = DONTWAIT | if i + 1 < frames.len() { SNDMORE } else { 0 };
            // SAFETY: libzmq copies the bytes
            unsafe { zmq_send(self.raw, bytes.as_ptr().cast(), bytes.len(), flags) >= 0 }
        })
    }

    /// Return the frames of the next message; None if there is none.
    pub fn receive(&self) -> Option<Vec<Frame>> {
        let mut frames = vec![Frame::receive(self.raw)?];
        while frames.last().is_some_and(Frame::more) {
            frames.push(Frame::receive(self.raw)?);
        }
        Some(frames)
    }

    /// Return the next event of a monitor.
    pub fn event(&self) -> Option<u16> {
        let frames = self.receive()?;
        Some(u16::from_ne_bytes(frames[0].get(..2)?.try_into().ok()?))
    }
}

/// Wait until one of the sockets has something to receive.
pub fn poll(sockets: &[&Socket], timeout: Option<Duration>) {
    let mut items: Vec<PollItem> =
        sockets.iter().map(|socket| PollItem { socket: socket.raw, descriptor: 0, events: POLLIN, ready: 0 }).collect();
    let milliseconds = timeout.map_or(-1, |time| c_long::try_from(time.as_millis()).unwrap_or(c_long::MAX));
    // SAFETY: as many items as said; an interruption by a signal counts as a message
    unsafe { zmq_poll(items.as_mut_ptr(), items.len() as c_int, milliseconds) };
}

impl std::fmt::Debug for Frame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "a frame of {} bytes", self.len())
    }
}

/// One frame, in the buffer into which libzmq received it.
pub struct Frame(Box<RawMessage>);
// SAFETY: a message has one owner, and its data are only written through `&mut`
unsafe impl Send for Frame {}
unsafe impl Sync for Frame {}

impl Frame {
    fn receive(socket: *mut c_void) -> Option<Frame> {
        let mut frame = Frame(Box::new(RawMessage([0; 64])));
        // SAFETY: initialised before it is used; on failure it stays empty
        unsafe {
            zmq_msg_init(&mut *frame.0);
            (zmq_msg_recv(&mut *frame.0, socket, DONTWAIT) >= 0).then_some(frame)
        }
    }

    /// Return bytes from elsewhere, such as a file, as a frame.
    pub fn copy_of(bytes: &[u8]) -> Frame {
        let mut frame = Frame(Box::new(RawMessage([0; 64])));
        // SAFETY: initialised with as many bytes as are written
        let code = unsafe { zmq_msg_init_size(&mut *frame.0, bytes.len()) };
        assert!(code == 0, "no memory for {} bytes", bytes.len());
        frame.bytes_mut().copy_from_slice(bytes);
        frame
    }

    fn more(&self) -> bool {
        // SAFETY: initialised
        unsafe { zmq_msg_more(&*self.0) != 0 }
    }

    pub fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: a received message's data are ours alone
        unsafe { std::slice::from_raw_parts_mut(zmq_msg_data(&mut *self.0).cast(), zmq_msg_size(&*self.0)) }
    }
}

impl Deref for Frame {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        let raw: *const RawMessage = &*self.0;
        // SAFETY: zmq_msg_data only looks up the address
        unsafe { std::slice::from_raw_parts(zmq_msg_data(raw.cast_mut()).cast(), zmq_msg_size(raw)) }
    }
}

impl Drop for Frame {
    fn drop(&mut self) {
        // SAFETY: initialised, and not used afterwards
        unsafe { zmq_msg_close(&mut *self.0) };
    }
}
