//! One scan or spectrum, followed by published packets. Pure: takes packets, returns an outcome.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::model::{Message, Packet, Region, ScopeStatus};
use crate::proto::ScopeState;

const FITS: f64 = 1e-2; // of the size: a controller's rounding, not another region
const SPOT_M: f64 = 20e-9; // a scanner with sensors reports the measured position, some nanometres from the requested one
const MOVED: f64 = 0.5; // of the size: with drift correction a scan is published at its registered position
const SHEARED: f64 = 0.1;

/// A requested measurement; None: as set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Target {
    Scan { region: Option<Region>, shape: Option<[usize; 2]>, drifts: bool },
    Spectrum { at_m: Option<[f64; 2]>, kind: Option<String>, drifts: bool },
}

impl Target {
    pub fn what(&self) -> &'static str {
        if matches!(self, Target::Scan { .. }) {
            "scan"
        } else {
            "spectrum"
        }
    }

    pub fn start(&self) -> &'static str {
        if matches!(self, Target::Scan { .. }) {
            "start-scan"
        } else {
            "start-spec"
        }
    }

    fn busy(&self) -> ScopeState {
        if matches!(self, Target::Scan { .. }) {
            ScopeState::SsScanning
        } else {
            ScopeState::SsSpec
        }
    }

    /// Return whether a packet can be a result of this target; None for another kind of packet.
    fn fits(&self, packet: &Packet) -> Option<bool> {
        match (self, &packet.message) {
            (Target::Scan { region, shape, drifts }, Message::Scan(scan)) => {
                let is_near = |wanted: &Region| {
                    if !drifts {
                        return wanted.is_near(&scan.region, FITS);
                    }
                    let [x, y] = [0, 1].map(|i| wanted.center_m[i] - scan.region.center_m[i]);
                    let there = Region { center_m: scan.region.center_m, ..*wanted };
                    x.hypot(y) <= MOVED * wanted.size_m[0].min(wanted.size_m[1]) && there.is_near(&scan.region, SHEARED)
                };
                Some(shape.is_none_or(|shape| shape == scan.shape) && region.as_ref().is_none_or(is_near))
            }
            (Target::Spectrum { at_m, kind, drifts }, Message::Spectrum(spectrum)) => {
                let is_near = match (at_m, spectrum.position_m) {
                    (Some(wanted), Some(found)) if !drifts => {
                        (wanted[0] - found[0]).hypot(wanted[1] - found[1]) <= SPOT_M
                    }
                    _ => true,
                };
                Some(is_near && kind.as_ref().is_none_or(|kind| *kind == spectrum.kind))
            }
            _ => None,
        }
    }
}

/// The outcome of a cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    Completed,
    /// The microscope published an interruption.
    Interrupted,
    /// The microscope is free without a result, for example after a restart of the translator.
    Vanished,
    /// The results do not match the request.
    Another,
}

/// The busy state, then results, then FREE.
pub struct Cycle {
    target: Target,
    /// Packets up to this time belong to an earlier measurement.
    since_ns: Option<i64>,
    /// It was requested in an earlier life, or control was lost: another component may have measured since.
    resumed: bool,
    pub begun: bool,
    pub outcome: Option<Outcome>,
    /// Results that fit.
    pub results: Vec<Arc<Packet>>,
    other: bool,
}

impl Cycle {
    pub fn new(target: Target, since_ns: Option<i64>, resumed: bool) -> Cycle {
        Cycle { target, since_ns, resumed, begun: false, outcome: None, results: Vec::new(), other: false }
    }

    pub fn control_was_lost(&mut self) {
        self.resumed = true;
    }

    /// Process a packet of the scheduler.
    pub fn take(&mut self, packet: &Arc<Packet>) {
        let is_old = match packet.time_ns {
            Some(time_ns) => self.since_ns.is_some_and(|since_ns| time_ns <= since_ns),
            None => self.resumed,
        };
        if self.outcome.is_some() || is_old {
            return;
        }
        match (&packet.message, self.target.fits(packet)) {
            (Message::Scope(status), _) => self.take_state(*status),
            (_, Some(true)) => {
                self.begun = true;
                self.results.push(packet.clone());
            }
            (_, Some(false)) => self.other |= self.begun,
            _ => {}
        }
    }

    fn take_state(&mut self, status: ScopeStatus) {
        if status.state == self.target.busy() {
            self.results.clear(); // results from before the start belong to another measurement
            (self.begun, self.other) = (true, false);
        } else if self.begun && status.state == ScopeState::SsInterrupted {
            self.outcome = Some(Outcome::Interrupted);
        } else if self.begun && status.state == ScopeState::SsFree {
            self.outcome = Some(match (self.results.is_empty(), self.other) {
                (false, _) => Outcome::Completed,
                (true, false) => Outcome::Vanished,
                (true, true) => Outcome::Another,
            });
        }
    }
}
