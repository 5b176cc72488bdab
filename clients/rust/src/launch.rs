//! The launch line: one line of JSON that describes a component's part in an experiment.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::Deserialize;
use serde_json::Value;

use crate::error::{Error, Result};

/// A component's part in an experiment.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
pub struct Launch {
    /// The component's name.
    pub name: String,
    /// Its settings in the experiment file.
    pub settings: Value,
    pub sockets: Sockets,
    /// Prefixes of its envelopes; None: all.
    pub envelopes: Option<Vec<String>>,
    pub clock: Clock,
    /// Problems that the experiment file names.
    pub problems: BTreeMap<String, u8>,
    /// The folder of the run.
    pub run_dir: PathBuf,
    /// The folder for data that survive a restart; empty: none survive.
    pub state_dir: PathBuf,
    pub beat_period_s: f64,
    pub beat_token: String,
    pub request_timeout_s: f64,
    #[serde(default = "three")]
    pub request_retries: u32,
    pub keys: Option<Keys>,
    /// Other computers may be connected without keys: the experiment file says `[security] insecure = true`.
    #[serde(skip)]
    pub insecure: bool,
    /// The identity of the run; empty: unknown.
    pub run: String,
    /// True only if the microscope is certainly simulated.
    pub simulated: bool,
    /// Positions are in sample coordinates, which the scheduler maps to tip coordinates.
    pub sample_coordinates: bool,
}

fn three() -> u32 {
    3
}

/// The addresses of one process.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
pub struct Sockets {
    /// The addresses of publishers; the first is the scheduler's.
    pub subscribe: Vec<String>,
    /// The scheduler's address for requests.
    pub control: Option<String>,
    /// The supervisor's address for heartbeats.
    pub heartbeat: Option<String>,
}

/// The experiment's clock, which a simulation speeds up.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
pub struct Clock {
    origin_s: f64,
    start_s: f64,
    speed: Option<f64>,
}

impl Clock {
    /// Return the experiment's time in ns since 1970.
    ///
    /// A simulated clock that waits for late components is slower than this formula.
    pub fn now_ns(&self) -> i64 {
        let real_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as i64);
        let Some(speed) = self.speed else { return real_ns };
        let since_origin_s = (real_ns - (self.origin_s * 1e9) as i64) as f64 * 1e-9;
        (self.start_s * 1e9) as i64 + (since_origin_s * speed * 1e9) as i64
    }
}

/// The CURVE key pair of the component, and the owner of the key at each address. Keys are Z85 text.
#[derive(Clone, Default, Deserialize)]
#[serde(default)]
pub struct Keys {
    pub public: String,
    pub secret: String,
    /// Public keys, and the names of their owners.
    pub peers: BTreeMap<String, String>,
    /// Addresses, and the names of the processes that bind them.
    pub servers: BTreeMap<String, String>,
    /// All connections are encrypted; else those to `servers`.
    pub everywhere: bool,
    /// "true" in the keys of an experiment without encryption, which have no pair.
    insecure: String,
}

impl std::fmt::Debug for Keys {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Keys {{ public: {:?}, .. }}", self.public)
    }
}

impl Keys {
    /// Return the public key that the owner of `address` must have; None: the connection is plain.
    pub fn server_key(&self, address: &str) -> Result<Option<&str>> {
        let Some(owner) = self.servers.get(address) else {
            if !self.everywhere {
                return Ok(None);
            }
            return Err(Error::Config(format!("{address}: it is not known whose key to expect there")));
        };
        let key = self.peers.iter().find(|(_, name)| *name == owner).map(|(key, _)| key.as_str());
        key.map(Some).ok_or_else(|| Error::Config(format!("{address}: there is no public key of {owner:?}")))
    }
}

impl Launch {
    /// Read a launch line.
    pub fn from_json(line: &str) -> Result<Launch> {
        let read: std::result::Result<Launch, _> = serde_json::from_str(line);
        let mut launch = read.map_err(|error| Error::Config(format!("the launch line can't be read: {error}")))?;
        // an experiment without encryption has `{"insecure": "true"}` there, or null
        launch.insecure = launch.keys.as_ref().is_some_and(|keys| keys.insecure == "true");
        launch.keys = launch.keys.filter(|keys| !keys.secret.is_empty());
        if launch.name.is_empty() {
            return Err(Error::Config("the launch line names no process".into()));
        }
        if launch.keys.as_ref().is_some_and(|keys| keys.secret.len() != 40 || keys.public.len() != 40) {
            return Err(Error::Config("the keys of the launch line are no pair of 40 characters each".into()));
        }
        Ok(Launch {
            beat_period_s: if launch.beat_period_s > 0.0 { launch.beat_period_s } else { 1.0 },
            request_timeout_s: if launch.request_timeout_s > 0.0 { launch.request_timeout_s } else { 5.0 },
            ..launch
        })
    }

    /// Return the launch line of a guest that joins a running experiment by the folder of its run.
    pub fn of_guest(run: &Path, name: &str) -> Result<Launch> {
        let file = run.join("run.json");
        let about: Value = serde_json::from_str(&read(&file)?).map_err(|error| unreadable(&file, &error))?;
        let mut guest = about.get("guest").cloned().filter(Value::is_object).ok_or_else(|| {
            Error::Config(format!("{}: no component of this experiment runs on this computer", file.display()))
        })?;
        guest["name"] = name.into();
        guest["state_dir"] = run.join("state").to_string_lossy().into();
        let keys = run.join("state").join("guest.keys");
        if keys.exists() {
            guest["keys"] = serde_json::from_str(&read(&keys)?).map_err(|error| unreadable(&keys, &error))?;
        }
        Launch::from_json(&guest.to_string())
    }

    pub(crate) fn request_timeout(&self) -> Duration {
        Duration::from_secs_f64(self.request_timeout_s.min(1e6))
    }
}

fn read(file: &Path) -> Result<String> {
    std::fs::read_to_string(file).map_err(|error| unreadable(file, &error))
}

fn unreadable(file: &Path, error: &dyn std::fmt::Display) -> Error {
    Error::File(format!("{}: can't be read: {error}", file.display()))
}
