//! Texts and bytes from the caller and into the caller's buffers.

use std::ffi::{c_char, c_int, CStr};

use native::{Error, Result};

/// The caller's buffer has no room for the whole of it.
pub struct TooSmall;

/// Return a text of the caller's; None for null.
pub unsafe fn text<'a>(pointer: *const c_char) -> Result<Option<&'a str>> {
    if pointer.is_null() {
        return Ok(None);
    }
    let text = CStr::from_ptr(pointer).to_str();
    text.map(Some).map_err(|_| Error::Invalid("a text is not UTF-8".into()))
}

pub unsafe fn required<'a>(pointer: *const c_char) -> Result<&'a str> {
    text(pointer)?.ok_or_else(|| Error::Invalid("a text is missing".into()))
}

pub unsafe fn bytes<'a>(pointer: *const u8, size: i64) -> Result<&'a [u8]> {
    match usize::try_from(size) {
        Ok(0) => Ok(&[]),
        Ok(size) if !pointer.is_null() => Ok(std::slice::from_raw_parts(pointer, size)),
        _ => Err(Error::Invalid("bytes are missing".into())),
    }
}

/// Copy as much of a text as fits, whole characters and a zero byte; return the length of all of it.
pub unsafe fn copy(text: &str, out: *mut c_char, capacity: c_int) -> c_int {
    let room = usize::try_from(capacity).unwrap_or(0);
    if room > 0 && !out.is_null() {
        let mut end = text.len().min(room - 1);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        std::ptr::copy_nonoverlapping(text.as_ptr().cast(), out, end);
        *out.add(end) = 0;
    }
    c_int::try_from(text.len()).unwrap_or(c_int::MAX)
}

/// `copy` that is an error if not all of it fits.
pub unsafe fn fit(text: &str, out: *mut c_char, capacity: c_int) -> std::result::Result<(), TooSmall> {
    if copy(text, out, capacity) < capacity {
        Ok(())
    } else {
        Err(TooSmall)
    }
}

/// Copy numbers, if all fit.
pub unsafe fn fit_all<T: Copy>(values: &[T], out: *mut T, capacity: i64) -> std::result::Result<(), TooSmall> {
    if values.is_empty() {
        return Ok(());
    }
    if out.is_null() || usize::try_from(capacity).unwrap_or(0) < values.len() {
        return Err(TooSmall);
    }
    std::ptr::copy_nonoverlapping(values.as_ptr(), out, values.len());
    Ok(())
}

/// Write a value where the caller wants it, if the caller does.
pub unsafe fn put<T>(out: *mut T, value: T) {
    if !out.is_null() {
        out.write(value);
    }
}
