//! Nearest surfel by look-up: a dense grid around the surface, two sides per cell.

use std::sync::Arc;

use nalgebra::Vector3;

use super::Surfel;

/// Edge of a cell \[m\].
const CELL: f64 = 0.010;
/// How far from the surface the look-up reaches \[m\].
pub const REACH: f64 = 0.045;
const NONE: u32 = u32::MAX;
/// Cells at most; larger parts get coarser cells.
const MOST_CELLS: f64 = 4e6;

/// For each cell near the surface, the nearest surfel and the nearest one facing the other way.
#[derive(Clone, Debug)]
pub struct NearestField {
    origin: Vector3<f64>,
    cell: f64,
    shape: [usize; 3],
    /// Shared by copies: they are by far the largest part of a model.
    cells: Arc<[[u32; 2]]>,
}

impl NearestField {
    /// The look-up for these surfels.
    pub fn new(surfels: &[Surfel]) -> Self {
        let mut low = Vector3::repeat(f64::INFINITY);
        let mut high = Vector3::repeat(f64::NEG_INFINITY);
        for surfel in surfels {
            low = low.inf(&surfel.point);
            high = high.sup(&surfel.point);
        }
        if surfels.is_empty() {
            (low, high) = (Vector3::zeros(), Vector3::zeros());
        }
        let extent = high - low + Vector3::repeat(2.0 * REACH);
        let cell = CELL.max((extent.product() / MOST_CELLS).cbrt());
        let shape = [0, 1, 2].map(|axis| (extent[axis] / cell).ceil() as usize + 1);
        let mut field = Self { origin: low - Vector3::repeat(REACH), cell, shape, cells: Arc::default() };
        field.cells = field.filled(surfels).into();
        field
    }

    fn filled(&self, surfels: &[Surfel]) -> Vec<[u32; 2]> {
        let mut cells = vec![[NONE; 2]; self.shape.iter().product()];
        let mut distances = vec![[f32::INFINITY; 2]; cells.len()];
        let reach = REACH / self.cell;
        let reach_squared = (reach * reach) as f32;
        for (index, surfel) in surfels.iter().enumerate() {
            let center = (surfel.point - self.origin) / self.cell;
            // Cells within reach along an axis, with the distances of their middles.
            let along = |axis: usize, reach: f64| {
                let first = (center[axis] - 0.5 - reach).ceil().max(0.0) as usize;
                let end = ((center[axis] - 0.5 + reach).floor() as usize + 1).min(self.shape[axis]);
                (first..end).map(move |k| (k, (k as f64 + 0.5 - center[axis]) as f32))
            };
            for (x, dx) in along(0, reach) {
                for (y, dy) in along(1, reach) {
                    let abreast = dx * dx + dy * dy;
                    let left = reach_squared - abreast;
                    if left < 0.0 {
                        continue;
                    }
                    let row = (x * self.shape[1] + y) * self.shape[2];
                    for (z, dz) in along(2, f64::from(left).sqrt()) {
                        let (cell, distances) = (&mut cells[row + z], &mut distances[row + z]);
                        insert(cell, distances, index as u32, abreast + dz * dz, surfels);
                    }
                }
            }
        }
        cells
    }

    /// The surfels nearest to `point`: the nearest, and the nearest of those that face away from it.
    pub fn nearest(&self, point: &Vector3<f64>) -> [Option<u32>; 2] {
        let scaled = (point - self.origin) / self.cell;
        if scaled.min() < 0.0 {
            return [None; 2];
        }
        let (x, y, z) = (scaled.x as usize, scaled.y as usize, scaled.z as usize);
        if x >= self.shape[0] || y >= self.shape[1] || z >= self.shape[2] {
            return [None; 2];
        }
        self.cells[(x * self.shape[1] + y) * self.shape[2] + z].map(|index| (index != NONE).then_some(index))
    }
}

/// Keeps the nearest surfel of a cell, and the nearest facing the other way (normals over 90° apart), by the
/// squares of their distances.
fn insert(cell: &mut [u32; 2], distances: &mut [f32; 2], index: u32, distance: f32, surfels: &[Surfel]) {
    let opposed = |a: u32, b: u32| surfels[a as usize].normal.dot(&surfels[b as usize].normal) < 0.0;
    if distance < distances[0] {
        if cell[0] != NONE && opposed(cell[0], index) {
            (cell[1], distances[1]) = (cell[0], distances[0]);
        } else if cell[1] != NONE && !opposed(cell[1], index) {
            (cell[1], distances[1]) = (NONE, f32::INFINITY);
        }
        (cell[0], distances[0]) = (index, distance);
    } else if distance < distances[1] && opposed(cell[0], index) {
        (cell[1], distances[1]) = (index, distance);
    }
}
