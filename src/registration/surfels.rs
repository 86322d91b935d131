//! A part's reference model: surfels with outward normals, grown from registered scans.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::ScanPoint;
use super::field::NearestField;
use super::outline::Outline;
use crate::math::Pose;

/// Edge of the averaging voxels \[m\].
const VOXEL: f64 = 0.010;
/// Radius over which normals are fitted \[m\]: disparity steps are millimetres to centimetres at
/// 2 m, and a smaller radius sees them as slopes.
const NORMAL_RADIUS: f64 = 0.045;
/// A plane takes over the surfels within this angle of it: cos 20°.
const SNAP_COSINE: f64 = 0.94;
/// A plane needs this many surfels to snap others to it.
const PLANE_SURFELS: usize = 20;
/// A part needs this many surfels to be registered.
const FEWEST_SURFELS: usize = 20;
/// A later surfel this far from those of the first look is a new face \[m\].
const NEW_FACE_DISTANCE: f64 = 0.015;
/// Viewing directions are told apart by the nearest of the 12 vertices of an icosahedron.
const GOLDEN: f64 = 1.618_033_988_749_895;
/// A voxel's mean gains nothing from more points than this; it also bounds drift of old sums.
const FULL_VOXEL: f64 = 400.0;

/// A small piece of surface at the reference configuration.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "StoredSurfel", into = "StoredSurfel")]
pub struct Surfel {
    /// Centre \[m\].
    pub point: Vector3<f64>,
    /// Unit normal, towards the side it was seen from (either side for fused clouds).
    pub normal: Vector3<f64>,
    /// Standard deviation of scan points along the normal \[m\].
    pub sigma: f64,
    /// Whether the viewing side is known.
    pub sided: bool,
    /// Whether it was first seen after the part had moved, and so stands where the fit put it.
    pub grown: bool,
}

/// A surfel without names: there are thousands. Point, normal, sigma, sided, grown.
type StoredSurfel = ([f64; 3], [f64; 3], f64, bool, bool);

impl From<Surfel> for StoredSurfel {
    fn from(Surfel { point, normal, sigma, sided, grown }: Surfel) -> Self {
        (point.into(), normal.into(), sigma, sided, grown)
    }
}

impl From<StoredSurfel> for Surfel {
    fn from((point, normal, sigma, sided, grown): StoredSurfel) -> Self {
        Self { point: point.into(), normal: normal.into(), sigma, sided, grown }
    }
}

#[derive(Clone, Debug, Default)]
struct VoxelSum {
    count: f64,
    sum: Vector3<f64>,
    outer: Matrix3<f64>,
}

/// Accumulates registered scans of one part into voxel averages; memory is bounded by its surface.
#[derive(Clone, Debug, Default)]
pub struct SurfelAccumulator {
    /// Keyed by viewing side (0 unknown, 1..=12) and voxel.
    voxels: BTreeMap<(u8, [i32; 3]), VoxelSum>,
    views: BTreeMap<u8, Vector3<f64>>,
    scans: usize,
}

impl SurfelAccumulator {
    /// How many scans went in.
    pub fn scans(&self) -> usize {
        self.scans
    }

    /// Adds a scan of the part at `displacement` from its reference configuration.
    pub fn add(&mut self, points: &[ScanPoint], displacement: &Pose) {
        let reference_from_world = displacement.inverse();
        for scan_point in points {
            let point = reference_from_world.transform_point(&scan_point.point_in_world);
            let side = scan_point.viewpoint_in_world.map_or(0, |viewpoint| {
                let view = (reference_from_world.transform_point(&viewpoint) - point).normalize();
                let side = viewing_side(&view);
                *self.views.entry(side).or_default() += view;
                side
            });
            let key = point.map(|x| (x / VOXEL).floor() as i32);
            let voxel = self.voxels.entry((side, [key.x, key.y, key.z])).or_default();
            if voxel.count < FULL_VOXEL {
                voxel.count += 1.0;
                voxel.sum += point;
                voxel.outer += point * point.transpose();
            }
        }
        self.scans += 1;
    }

    /// Mean positions of the occupied voxels \[m\], those seen in at least `least` points.
    pub fn voxel_means(&self, least: f64) -> Vec<Vector3<f64>> {
        self.voxels.values().filter(|v| v.count >= least).map(|v| v.sum / v.count).collect()
    }

    /// The surfels of everything added so far.
    pub fn surfels(&self) -> Vec<Surfel> {
        let least = 1.0;
        let mut surfels = Vec::new();
        let mut sides: Vec<u8> = self.voxels.keys().map(|(side, _)| *side).collect();
        sides.dedup();
        for side in sides {
            let view = self.views.get(&side).map(|v| v.normalize());
            let mut side_surfels = self.surfels_of_side(side, view.as_ref(), least);
            snap_to_planes(&mut side_surfels);
            surfels.append(&mut side_surfels);
        }
        surfels
    }

    fn surfels_of_side(&self, side: u8, view: Option<&Vector3<f64>>, least: f64) -> Vec<Surfel> {
        let mut surfels = Vec::new();
        let voxels = SideVoxels::new(self.voxels.range((side, [i32::MIN; 3])..=(side, [i32::MAX; 3])), least);
        for (key, center, _) in &voxels.0 {
            let center = *center;
            let mut count = 0.0;
            let mut sum = Vector3::zeros();
            let mut outer = Matrix3::zeros();
            for (_, mean, neighbour) in voxels.around(*key) {
                if (mean - center).norm_squared() <= NORMAL_RADIUS * NORMAL_RADIUS {
                    count += neighbour.count;
                    sum += neighbour.sum;
                    outer += neighbour.outer;
                }
            }
            if count < 8.0 {
                continue;
            }
            let mean = sum / count;
            let eigen = (outer / count - mean * mean.transpose()).symmetric_eigen();
            let thin = eigen.eigenvalues.imin();
            let mut spread: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
            spread.sort_by(f64::total_cmp);
            if spread[0] > 0.4 * spread[1] {
                continue;
            }
            let mut normal: Vector3<f64> = eigen.eigenvectors.column(thin).into();
            if let Some(view) = view {
                normal *= normal.dot(view).signum();
            }
            surfels.push(Surfel {
                point: center - normal * normal.dot(&(center - mean)),
                normal,
                sigma: spread[0].max(0.0).sqrt().clamp(0.001, 0.020),
                sided: view.is_some(),
                grown: false,
            });
        }
        surfels
    }
}

/// The voxels of one side: key, mean position \[m\] and sums, in the order of their keys.
struct SideVoxels<'a>(Vec<([i32; 3], Vector3<f64>, &'a VoxelSum)>);

impl<'a> SideVoxels<'a> {
    fn new(range: impl Iterator<Item = (&'a (u8, [i32; 3]), &'a VoxelSum)>, least: f64) -> Self {
        Self(range.filter(|(_, v)| v.count >= least).map(|(&(_, key), v)| (key, v.sum / v.count, v)).collect())
    }

    /// The voxels in the cube of the normals' radius around a key, in the order of their keys.
    fn around(&self, key: [i32; 3]) -> impl Iterator<Item = &([i32; 3], Vector3<f64>, &'a VoxelSum)> {
        let reach = (NORMAL_RADIUS / VOXEL).ceil() as i32;
        let near = move |x: i32, middle: i32| x.abs_diff(middle) <= reach.unsigned_abs();
        (key[0].saturating_sub(reach)..=key[0].saturating_add(reach))
            .flat_map(move |x| {
                let from = self.0.partition_point(|(k, ..)| [k[0], k[1]] < [x, key[1].saturating_sub(reach)]);
                self.0[from..].iter().take_while(move |(k, ..)| k[0] == x && (k[1] <= key[1] || near(k[1], key[1])))
            })
            .filter(move |(k, ..)| near(k[2], key[2]))
    }
}

/// Which of 12 viewing directions, from 1.
fn viewing_side(view: &Vector3<f64>) -> u8 {
    let mut best = (f64::NEG_INFINITY, 0);
    for index in 0..12u8 {
        let a = if index & 1 == 0 { 1.0 } else { -1.0 };
        let b = if index & 2 == 0 { GOLDEN } else { -GOLDEN };
        let vertex = match index / 4 {
            0 => Vector3::new(0.0, a, b),
            1 => Vector3::new(a, b, 0.0),
            _ => Vector3::new(b, 0.0, a),
        };
        let cosine = vertex.dot(view);
        if cosine > best.0 {
            best = (cosine, index + 1);
        }
    }
    best.1
}

/// Replaces the normals and offsets of surfels that lie in a common plane by the plane's own.
///
/// Local normals carry the noise of a few dozen points; read as geometry they would pretend to
/// hold a flat panel against sliding along itself.
fn snap_to_planes(surfels: &mut [Surfel]) {
    let mut free: Vec<usize> = (0..surfels.len()).collect();
    for _ in 0..6 {
        let stride = (free.len() / 150).max(1);
        let mut best: Vec<usize> = Vec::new();
        for &seed in free.iter().step_by(stride) {
            let members = plane_members(surfels, &free, &surfels[seed].point, &surfels[seed].normal);
            if members.len() > best.len() {
                best = members;
            }
        }
        let mut plane = None;
        for _ in 0..4 {
            if best.len() < PLANE_SURFELS {
                return;
            }
            let (center, normal) = fit_plane(surfels, &best);
            best = plane_members(surfels, &free, &center, &normal);
            plane = Some((center, normal));
        }
        let Some((center, normal)) = plane else { return };
        for &index in &best {
            let surfel = &mut surfels[index];
            let sign = surfel.normal.dot(&normal).signum();
            surfel.normal = normal * sign;
            surfel.point -= normal * normal.dot(&(surfel.point - center));
        }
        free.retain(|index| !best.contains(index));
    }
}

fn plane_members(surfels: &[Surfel], free: &[usize], center: &Vector3<f64>, normal: &Vector3<f64>) -> Vec<usize> {
    free.iter()
        .copied()
        .filter(|&index| {
            let surfel = &surfels[index];
            let height = (surfel.point - center).dot(normal).abs();
            height < (1.2 * surfel.sigma).max(0.003) && surfel.normal.dot(normal).abs() > SNAP_COSINE
        })
        .collect()
}

fn fit_plane(surfels: &[Surfel], members: &[usize]) -> (Vector3<f64>, Vector3<f64>) {
    let count = members.len() as f64;
    let center = members.iter().map(|&i| surfels[i].point).sum::<Vector3<f64>>() / count;
    let scatter = members
        .iter()
        .map(|&i| {
            let d = surfels[i].point - center;
            d * d.transpose()
        })
        .sum::<Matrix3<f64>>();
    let eigen = scatter.symmetric_eigen();
    (center, eigen.eigenvectors.column(eigen.eigenvalues.imin()).into())
}

/// A part's surfels with a nearest-surfel look-up, at the reference configuration.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(from = "PlainModel")]
pub struct PartModel {
    /// The surfels.
    pub surfels: Vec<Surfel>,
    /// Mean of the surfels \[m\]: what rotations are taken about.
    pub centroid: Vector3<f64>,
    /// Root-mean-square distance from the centroid \[m\]: scales rotations to lengths.
    pub radius: f64,
    /// Outlines of its flat faces at the first look, once they are calibrated.
    pub outlines: Vec<Outline>,
    #[serde(skip)]
    pub(super) field: NearestField,
}

/// A model without the look-up, as it is saved.
#[derive(Deserialize)]
struct PlainModel {
    surfels: Vec<Surfel>,
    centroid: Vector3<f64>,
    radius: f64,
    outlines: Vec<Outline>,
}

impl From<PlainModel> for PartModel {
    fn from(PlainModel { surfels, centroid, radius, outlines }: PlainModel) -> Self {
        let field = NearestField::new(&surfels);
        Self { surfels, centroid, radius, outlines, field }
    }
}

impl PartModel {
    /// A model of the surfels seen at the reference configuration; `None` with too few of them.
    pub fn new(reference: &[Surfel]) -> Option<Self> {
        (reference.len() >= FEWEST_SURFELS).then(|| Self::of(reference.to_vec()))
    }

    /// This model of the first look, with the surfels that came into view later where it has none.
    pub fn grown(&self, later: &[Surfel]) -> Self {
        let first = self;
        let new_face = |surfel: &&Surfel| {
            first.field.nearest(&surfel.point).into_iter().flatten().all(|index| {
                let near = &first.surfels[index as usize];
                let same_side = !near.sided || near.normal.dot(&surfel.normal) > 0.5;
                !same_side || (near.point - surfel.point).norm() > NEW_FACE_DISTANCE
            })
        };
        let grown: Vec<Surfel> = later.iter().filter(new_face).map(|s| Surfel { grown: true, ..*s }).collect();
        if grown.is_empty() {
            return first.clone();
        }
        first.with(&grown)
    }

    /// This model of the first look with surfels that were taken for new faces.
    pub fn with(&self, grown: &[Surfel]) -> Self {
        let (centroid, radius, outlines) = (self.centroid, self.radius, self.outlines.clone());
        Self { centroid, radius, outlines, ..Self::of([self.surfels.as_slice(), grown].concat()) }
    }

    /// A part of which only a frame's pose is measured: nothing to register, \[m\].
    pub fn of_frame(origin: Vector3<f64>, radius: f64) -> Self {
        let field = NearestField::new(&[]);
        Self { surfels: Vec::new(), centroid: origin, radius, outlines: Vec::new(), field }
    }

    fn of(surfels: Vec<Surfel>) -> Self {
        let count = surfels.len().max(1) as f64;
        let centroid = surfels.iter().map(|s| s.point).sum::<Vector3<f64>>() / count;
        let variance = surfels.iter().map(|s| (s.point - centroid).norm_squared()).sum::<f64>() / count;
        let field = NearestField::new(&surfels);
        Self { surfels, centroid, radius: variance.sqrt().max(0.02), outlines: Vec::new(), field }
    }

    /// Finds the outlines of the flat faces from scans at the reference configuration: the part's points
    /// and those of all others, by frame.
    pub fn calibrate_outlines(&mut self, scans: &[(&[ScanPoint], Vec<ScanPoint>)]) {
        self.outlines = Outline::of(&self.surfels);
        for outline in &mut self.outlines {
            outline.calibrate(scans);
        }
    }

    /// Whether the first look found surface within a voxel and a half of a place.
    pub(super) fn has_surface_at(&self, place: &Vector3<f64>) -> bool {
        let near = |index: u32| {
            let surfel = &self.surfels[index as usize];
            !surfel.grown && (surfel.point - place).norm_squared() < (1.5 * VOXEL).powi(2)
        };
        self.field.nearest(place).into_iter().flatten().any(near)
    }

    /// A sphere about the centroid that holds the part, and a margin \[m\].
    pub fn reach(&self) -> f64 {
        self.surfels.iter().map(|s| (s.point - self.centroid).norm()).fold(0.0, f64::max) + 0.05
    }
}
