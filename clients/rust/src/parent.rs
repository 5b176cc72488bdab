//! Standard input, the bond to the parent process: its end means that the parent stops this process, or is gone.

use std::sync::Arc;
use std::time::Duration;
use std::{io, thread};

use libc::{c_int, c_void};

use crate::error::{Error, Result};
use crate::shared::Shared;

const END_WITHIN: Duration = Duration::from_millis(1500);
const ORPHAN: c_int = 81;
const CHUNK: usize = 1 << 16;

/// Standard input, taken from the rest of the process.
pub struct Pipe {
    descriptor: c_int,
    read: Vec<u8>,
}

impl Pipe {
    /// Take standard input, and leave an empty one in its place.
    ///
    /// On Windows, an operation on a pipe waits for the end of a read in any thread: a library that only inspects
    /// standard input would hang while a thread reads it. So only a duplicate is read.
    pub fn take() -> Result<Pipe> {
        let nothing = if cfg!(windows) { c"NUL" } else { c"/dev/null" };
        // SAFETY: plain calls of the C library with valid arguments
        let descriptor = unsafe {
            let descriptor = libc::dup(0);
            let empty = libc::open(nothing.as_ptr(), libc::O_RDONLY);
            if descriptor < 0 || empty < 0 || libc::dup2(empty, 0) < 0 {
                return Err(Error::Config(format!("standard input: {}", io::Error::last_os_error())));
            }
            libc::close(empty);
            descriptor
        };
        Ok(Pipe { descriptor, read: Vec::new() })
    }

    /// Return the next line without its end; None at the end of the pipe.
    pub fn line(&mut self) -> Option<String> {
        loop {
            if let Some(end) = self.read.iter().position(|byte| *byte == b'\n') {
                let rest = self.read.split_off(end + 1);
                let line = std::mem::replace(&mut self.read, rest);
                return Some(String::from_utf8_lossy(&line[..end]).trim_end_matches('\r').to_owned());
            }
            let known = self.read.len();
            self.read.resize(known + CHUNK, 0);
            // SAFETY: the buffer has room for these bytes
            let count =
                unsafe { libc::read(self.descriptor, self.read[known..].as_mut_ptr().cast::<c_void>(), CHUNK as _) };
            self.read.truncate(known + usize::try_from(count).unwrap_or(0));
            if count <= 0 && io::Error::last_os_error().kind() != io::ErrorKind::Interrupted || count == 0 {
                return None;
            }
        }
    }
}

/// Ignore Ctrl-C, which reaches the whole terminal: the parent decides what it ends.
pub fn leave_interrupts_to_parent() {
    // SAFETY: signals that exist on every supported system
    unsafe {
        libc::signal(libc::SIGINT, libc::SIG_IGN);
        #[cfg(windows)]
        libc::signal(21, libc::SIG_IGN); // SIGBREAK
    }
}

/// Pass lines to `shared`; at the end of the pipe stop the process, by force if it does not end by itself.
pub fn watch(mut pipe: Pipe, shared: Arc<Shared>) {
    thread::spawn(move || {
        while let Some(line) = pipe.line() {
            shared.change(|state| state.lines.push_back(line));
        }
        shared.finish(Error::Stopped);
        thread::sleep(END_WITHIN);
        // SAFETY: ends the process
        unsafe { libc::_exit(ORPHAN) };
    });
}
