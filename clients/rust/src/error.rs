//! What can go wrong, each with its remedy.

use std::fmt;

use crate::proto::ControlResponse;

pub type Result<T> = std::result::Result<T, Error>;

/// Why a call did not succeed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Error {
    /// Scheduler, limit or microscope said no.
    Refused(Refusal),
    /// The time given was up.
    TimedOut(String),
    /// The measurement failed again and again without a reason; a person should look.
    MeasurementFailed(String),
    /// The experiment has ended: exit with 80.
    Ended,
    /// The parent has gone, or wants the process to stop: exit with 81.
    Stopped,
    /// Settings that can't work: exit with 78.
    Config(String),
    /// An argument that makes no sense.
    Invalid(String),
    /// Bytes that are no message.
    Wire(String),
    /// An address can't be used.
    Transport(String),
    /// A file can't be read or written.
    File(String),
}

/// A response that is no success.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// What was asked for.
    pub what: String,
    /// The number of a `ControlResponse`, or one that only a newer peer knows.
    pub response: u8,
    /// For a person; may be empty.
    pub reason: String,
    /// What a program must know beside the response: 1, the request was not sent; 2, it may or may not have been
    /// carried out; 3, the experiment has ended; 0 for none.
    pub detail: u8,
}

/// Return the name of a response, such as "REP_NOT_FREE", or its number.
pub fn response_name(response: u8) -> String {
    ControlResponse::try_from(i32::from(response))
        .map_or_else(|_| response.to_string(), |known| known.as_str_name().to_owned())
}

impl Error {
    /// Return the exit code by which a process tells its supervisor that it ends over this.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Ended => 80,
            Error::Stopped => 81,
            Error::Config(_) => 78,
            _ => 1,
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Error::Refused(Refusal { what, response, reason, .. }) => {
                write!(f, "{what} was refused: {}", response_name(*response))?;
                if reason.is_empty() {
                    Ok(())
                } else {
                    write!(f, ": {reason}")
                }
            }
            Error::Ended => f.write_str("the experiment has ended"),
            Error::Stopped => f.write_str("the process was asked to stop"),
            Error::TimedOut(text)
            | Error::MeasurementFailed(text)
            | Error::Config(text)
            | Error::Invalid(text)
            | Error::Wire(text)
            | Error::Transport(text)
            | Error::File(text) => f.write_str(text),
        }
    }
}

impl std::error::Error for Error {}
