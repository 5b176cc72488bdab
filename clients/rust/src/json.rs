//! Messages in protobuf's JSON mapping, by name: for programs that handle any message, and for the C library.

use std::sync::OnceLock;

use prost::Message as _;
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor, SerializeOptions};

use crate::error::{Error, Result};

fn descriptor(name: &str) -> Result<MessageDescriptor> {
    static POOL: OnceLock<DescriptorPool> = OnceLock::new();
    let pool = POOL.get_or_init(|| {
        let bytes: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/afspm.fds"));
        DescriptorPool::decode(bytes).expect("made by the build")
    });
    let full_name = format!("afspm.{name}");
    pool.get_message_by_name(&full_name).ok_or_else(|| Error::Invalid(format!("there is no message {name:?}")))
}

fn decoded(name: &str, bytes: &[u8]) -> Result<DynamicMessage> {
    DynamicMessage::decode(descriptor(name)?, bytes).map_err(|error| Error::Wire(format!("no {name}: {error}")))
}

/// Return the message `name` in bytes as JSON, with the field names of the `.proto` files.
pub fn to_json(name: &str, bytes: &[u8]) -> Result<String> {
    let mut text = Vec::new();
    let options = SerializeOptions::new().use_proto_field_name(true);
    let mut serializer = serde_json::Serializer::new(&mut text);
    let written = decoded(name, bytes)?.serialize_with_options(&mut serializer, &options);
    written.map_err(|error| Error::Wire(format!("a {name} that JSON can't hold: {error}")))?;
    String::from_utf8(text).map_err(|_| Error::Wire("JSON that is not UTF-8".into()))
}

/// Return JSON as the bytes of the message `name`.
pub fn from_json(name: &str, json: &str) -> Result<Vec<u8>> {
    let mut deserializer = serde_json::Deserializer::from_str(json);
    let message = DynamicMessage::deserialize(descriptor(name)?, &mut deserializer)
        .map_err(|error| Error::Invalid(format!("no {name}: {error}")))?;
    deserializer.end().map_err(|error| Error::Invalid(format!("no {name}: {error}")))?;
    Ok(message.encode_to_vec())
}

/// Decode the message `name` and encode it again; unknown fields are kept.
pub fn recoded(name: &str, bytes: &[u8]) -> Result<Vec<u8>> {
    Ok(decoded(name, bytes)?.encode_to_vec())
}
