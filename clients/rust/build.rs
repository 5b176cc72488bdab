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

/// `libsodium-sys-stable` builds libsodium, or uses that of `SODIUM_LIB_DIR`, and passes its path on; the `zmq` crate's libzmq
/// has no CURVE.
fn compile_libzmq() -> Result<(), Box<dyn Error>> {
    let (library, include) = match env::var("SODIUM_LIB_DIR") {
        Ok(library) => (PathBuf::from(&library), PathBuf::from(&library).join("../include")),
        Err(_) => (env::var("DEP_SODIUM_LIB")?.into(), env::var("DEP_SODIUM_INCLUDE")?.into()),
    };
    zeromq_src::Build::new().with_libsodium(Some(zeromq_src::LibLocation::new(library, include))).build();
    let target = env::var("TARGET")?;
    if target.contains("windows") {
        println!("cargo:rustc-link-lib=ws2_32\ncargo:rustc-link-lib=advapi32");
    }
    if target.ends_with("windows-gnu") {
        // what libzmq polls by on Windows, which that crate compiles for MSVC alone
        let wepoll = PathBuf::from(env::var("OUT_DIR")?).join("source/external/wepoll/wepoll.c");
        cc::Build::new().warnings(false).file(wepoll).compile("wepoll");
    }
    Ok(())
}
