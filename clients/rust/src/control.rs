//! Control: requesting it, waiting for it, noticing its loss, releasing it.

use std::sync::PoisonError;
use std::time::{Duration, Instant};

use crate::client::{refused, until, Client, NO_RESPONSE};
use crate::error::Result;
use crate::proto::{ControlRequest, ControlResponse};
use crate::shared::{earlier, State};
use crate::wire::Response;

const ASK_AGAIN: Duration = Duration::from_secs(10); // in case a published control state is not received
const WRONG_PROBLEM: u8 = ControlResponse::RepWrongExpProblem as u8;
/// Answers to a request for control that will be granted later.
const WAIT_FOR: [u8; 3] =
    [ControlResponse::RepAlreadyUnderControl as u8, ControlResponse::RepWrongControlMode as u8, WRONG_PROBLEM];

/// Keeps control until it is dropped.
pub struct Control<'a> {
    client: &'a Client,
    /// Whether control was not held before.
    is_outermost: bool,
}

impl Drop for Control<'_> {
    fn drop(&mut self) {
        if self.is_outermost {
            let _ = self.client.release_control(); // lost control or an ended experiment is no error here
        }
    }
}

impl Client {
    /// Wait for control, and hold it until the returned guard is dropped.
    ///
    /// Meanwhile control may still be lost to a problem or to MANUAL: then commands are refused, and measurements wait for
    /// it. `solving`: the flagged problem to solve, 0 for none.
    pub fn control(&self, solving: u8, timeout: Option<Duration>) -> Result<Control<'_>> {
        let is_outermost = self.shared.lock().hold.asked.is_none();
        self.request_control(solving, timeout)?;
        Ok(Control { client: self, is_outermost })
    }

    /// `control` for languages without scopes; each call needs one [`Client::release_control`].
    pub fn request_control(&self, solving: u8, timeout: Option<Duration>) -> Result<()> {
        let before = self.shared.change(|state| {
            let hold = &mut state.hold;
            hold.held &= hold.solving() == solving; // the scheduler decides about another problem
            hold.asked.replace(solving)
        });
        self.regain(until(timeout)).inspect_err(|_| {
            self.shared.change(|state| {
                let control = state.view.control.as_ref();
                state.hold.held =
                    before.is_some() && control.is_some_and(|now| now.holder.as_deref() == Some(self.name()));
                state.hold.asked = before;
            });
        })
    }

    /// Release control; while another thread measures, at the end of its measurement.
    pub fn release_control(&self) -> Result<()> {
        self.shared.change(|state| state.hold.asked = None);
        self.give_back()
    }

    /// Hold control during a measurement.
    pub(crate) fn hold(&self, until: Option<Instant>) -> Result<()> {
        self.shared.change(|state| state.hold.users += 1);
        self.regain(until).inspect_err(|_| self.shared.change(|state| state.hold.users -= 1))
    }

    pub(crate) fn release(&self) -> Result<()> {
        self.shared.change(|state| state.hold.users -= 1);
        self.give_back()
    }

    fn give_back(&self) -> Result<()> {
        if self.shared.change(|state| !state.hold.is_wanted() && std::mem::take(&mut state.hold.held)) {
            self.request(ControlRequest::ReqReleaseCtrl as u8, b"")?; // a refusal means that it was lost before
        }
        Ok(())
    }

    /// Return once in control: request it, wait for the control state to change, and request again.
    pub(crate) fn regain(&self, until: Option<Instant>) -> Result<()> {
        let _asking = self.asking.lock().unwrap_or_else(PoisonError::into_inner);
        let mut told = String::new();
        loop {
            let (held, solving, count, connection) = {
                let state = self.shared.lock();
                (state.hold.held, state.hold.solving(), state.view.counts.control, state.connections)
            };
            if held {
                return Ok(());
            }
            let id = self.next_id();
            let response = self.request_as(&id, ControlRequest::ReqRequestCtrl as u8, &[solving], until)?;
            if response.is_success() {
                self.shared.change(|state| state.gained(self.name()));
                continue;
            }
            self.check_waiting(&response, solving)?;
            if response.reason != told {
                self.log("INFO", &format!("waiting for control: {}", response.reason));
                told.clone_from(&response.reason);
            }
            self.shared.wait(earlier(ASK_AGAIN, until), |state| {
                let is_solved = solving != 0 && !state.view.is_flagged(solving);
                let may_ask = is_solved || state.obstacle(solving, self.name()).is_empty();
                (state.connections != connection || state.view.counts.control != count && may_ask).then_some(())
            })?;
            if until.is_some_and(|until| Instant::now() >= until) {
                return Err(refused("control", response));
            }
        }
    }

    /// Return an error if control can't be granted after any wait.
    fn check_waiting(&self, response: &Response, solving: u8) -> Result<()> {
        let is_flagged = self.shared.lock().view.is_flagged(solving);
        if solving != 0 && response.response == WRONG_PROBLEM && !is_flagged {
            return Err(refused("control", response.clone())); // there is nothing to solve
        }
        if WAIT_FOR.contains(&response.response) || response.response == NO_RESPONSE {
            return Ok(());
        }
        Err(refused("control", response.clone()))
    }
}

impl State {
    /// The state that names this component may arrive before the answer.
    fn gained(&mut self, name: &str) {
        self.hold.tenures += 1;
        self.hold.held = true;
        let control = self.view.control.as_ref();
        self.hold.was_named = control.is_some_and(|control| control.holder.as_deref() == Some(name));
    }
}
