//! Takes an overview, finds its flattest place, and scans that: a component in Rust, with the crate in clients/rust.

use std::process::ExitCode;

use afspm::{Client, Error, Region, Result, Scan};

fn main() -> ExitCode {
    afspm::run(find_flattest)
}

fn find_flattest(client: &Client) -> Result<()> {
    let size_m = client
        .setting("size_m")
        .as_f64()
        .ok_or_else(|| Error::Config("size_m is missing".into()))?;
    let tiles = client.setting("tiles").as_u64().unwrap_or(4) as usize;
    let pixels = client.setting("pixels").as_u64().unwrap_or(64) as usize;

    // a key has a scan taken once: started again after a crash, this program gets the scan of its earlier life
    let whole = Region::new([0.0, 0.0], [size_m, size_m]);
    let overview = client.scan(Some(whole), Some([pixels, pixels]), Some("overview"), None)?;
    let height = overview
        .scans()
        .find(|scan| scan.unit == "m")
        .ok_or_else(|| Error::Wire("no heights".into()))?;

    let edge = pixels / tiles;
    let places = (0..tiles * tiles).map(|i| (i / tiles * edge, i % tiles * edge));
    let rough = places.map(|(row, column)| (roughness_m(height, row, column, edge), row, column));
    let (rms_m, row, column) = rough
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .expect("at least one tile");

    let step_m = size_m / (pixels - 1) as f64;
    let middle = (edge - 1) as f64 / 2.0;
    let along_m = |pixel: usize| (pixel as f64 + middle) * step_m - size_m / 2.0;
    let place = Region::new([along_m(column), along_m(row)], [size_m / tiles as f64; 2]);
    let detail = client.scan(Some(place), Some([pixels, pixels]), Some("flattest"), None)?;
    let text = format!(
        "the flattest place, {:.3} nm rms, is at ({:.0}, {:.0}) nm",
        rms_m * 1e9,
        place.center_m[0] * 1e9,
        place.center_m[1] * 1e9
    );
    client.note(&text, detail.scans().next().and_then(|scan| scan.time_ns))?;
    client.log("INFO", &text);
    client.end_experiment()
}

/// Return the root mean square of the heights of a square tile about its plane.
fn roughness_m(scan: &Scan, row: usize, column: usize, edge: usize) -> f64 {
    let middle = (edge - 1) as f64 / 2.0;
    let (mut sum, mut sum_x, mut sum_y, mut squares, mut sum_xx) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for y in 0..edge {
        for x in 0..edge {
            let (z, dx, dy) = (
                scan.at(row + y, column + x),
                x as f64 - middle,
                y as f64 - middle,
            );
            sum += z;
            sum_x += z * dx;
            sum_y += z * dy;
            squares += z * z;
            sum_xx += dx * dx;
        }
    }
    let count = (edge * edge) as f64;
    ((squares - sum * sum / count - (sum_x * sum_x + sum_y * sum_y) / sum_xx).max(0.0) / count)
        .sqrt()
}
