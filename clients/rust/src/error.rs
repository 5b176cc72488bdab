//! The errors, each with its remedy.

use std::fmt;

use crate::proto::ControlResponse;

pub type Result<T> = std::result::Result<T, Error>;

/// The reason why a call failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Error {
    /// A refusal by the scheduler, a limit or the microscope.
    Refused(Refusal),
    /// The timeout is over.
    TimedOut(String),
    /// The measurement failed repeatedly without a known reason: a person has to look.
    MeasurementFailed(String),
    /// The experiment has ended: exit with 80.
    Ended,
    /// The parent is gone, or stops the process: exit with 81.
    Stopped,
    /// Settings that can't work: exit with 78.
    Config(String),
    /// A meaningless argument.
    Invalid(String),
    /// Bytes that violate the wire format.
    Wire(String),
    /// An address can't be used.
    Transport(String),
    /// A file can't be read or written.
    File(String),
}

/// An unsuccessful response.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// The request.
    pub what: String,
    /// The number of a `ControlResponse`, or one that only a newer peer knows.
    pub response: u8,
    /// For a person; may be empty.
    pub reason: String,
    /// Details for programs beside the response: 1, the request was not sent; 2, it may or may not have been
    /// carried out; 3, the experiment has ended; 0 for none.
    pub detail: u8,
}

/// Return the name of a response, such as "REP_NOT_FREE", or its number.
pub fn response_name(response: u8) -> String {
    ControlResponse::try_from(i32::from(response))
        .map_or_else(|_| response.to_string(), |known| known.as_str_name().to_owned())
}

impl Error {
    /// Return the exit code of a process that ends with this error.
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
