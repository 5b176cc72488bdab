//! Compiles the messages of `proto/`, without a protoc, and libzmq with CURVE (libsodium).

use std::{env, error::Error, fs, path::PathBuf};

use prost::Message;

fn main() -> Result<(), Box<dyn Error>> {
    compile_messages()?;
    compile_libzmq()
}

fn compile_messages() -> Result<(), Box<dyn Error>> {
    let folder = PathBuf::from(env::var("CARGO_MANIFEST_DIR")?).join("../../proto");
    let mut files: Vec<PathBuf> =
        fs::read_dir(&folder)?.map(|entry| entry.map(|entry| entry.path())).collect::<Result<_, _>>()?;
    files.retain(|file| file.extension().is_some_and(|end| end == "proto"));
    files.sort();
    println!("cargo:rerun-if-changed={}", folder.display());
    let descriptors = protox::compile(&files, [&folder])?;
    fs::write(PathBuf::from(env::var("OUT_DIR")?).join("afspm.fds"), descriptors.encode_to_vec())?;
    prost_build::Config::new().compile_fds(descriptors)?;
    Ok(())
}

/// `libsodium-sys-stable` has built libsodium, and tells where; the `zmq` crate's libzmq has no CURVE.
fn compile_libzmq() -> Result<(), Box<dyn Error>> {
    let sodium = zeromq_src::LibLocation::new(env::var("DEP_SODIUM_LIB")?, env::var("DEP_SODIUM_INCLUDE")?);
    zeromq_src::Build::new().with_libsodium(Some(sodium)).build();
    Ok(())
}
