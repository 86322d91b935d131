//! `~/robot_description`: the likeliest model as URDF, <http://wiki.ros.org/urdf/XML>.
//!
//! The fixed frame is the root link, the root part is fixed to it. Where nothing is known of a part's
//! joint it is fixed too, not floating: a planner may keep clear of what stands still, and needs no
//! joint state for it. What is seen where no joint of the tree could have it floats. URDF cannot hold a mesh, only name a file; without a folder for meshes every part
//! is a box.

use std::collections::BTreeMap;
use std::fmt::Write;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::link_tree::{Link, LinkJoint, LinkTree, joint_name, link_name};
use crate::geometry::{HullProperties, Surface};
use crate::types::Label;
use crate::types::finite::{NotFinite, check_finite};
use crate::types::posterior::{ObjectPosterior, Quantity};

/// URDF wants an effort and a rate that bound every joint; neither is inferred. \[N or N·m\], \[m/s or
/// rad/s\]
const UNBOUNDED: (f64, f64) = (1000.0, 10.0);
/// Way of a slide whose ends are not known of and that was never seen to move \[m\].
const OPEN_WAY: f64 = 1.0;
/// Vertices of a mesh at most.
const MESH_VERTICES: usize = 128;

/// What the description is made from, besides the posterior.
#[derive(Clone, Copy, Debug)]
pub struct UrdfInput<'a> {
    /// Name of the fixed frame.
    pub fixed_frame: &'a str,
    /// Hulls of the parts, world at the first frame.
    pub hulls: &'a BTreeMap<Label, HullProperties>,
    /// Least and greatest position seen \[m or rad\], by child: where no end stop is known of.
    pub ranges_seen: &'a BTreeMap<Label, (f64, f64)>,
    /// Absolute path of the folder that the meshes will be in.
    pub mesh_folder: Option<&'a str>,
}

/// The description, and the meshes it names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Urdf {
    /// The XML.
    pub text: String,
    /// File name and content (binary STL) of each mesh, to be written to the folder before the text is
    /// published. The name changes with the content, as viewers keep what they have loaded.
    pub meshes: Vec<(String, Vec<u8>)>,
}

/// The likeliest model as URDF.
///
/// # Errors
/// A number that is not finite, by name.
pub fn urdf(tree: &LinkTree, posterior: &ObjectPosterior, input: &UrdfInput<'_>) -> Result<Urdf, NotFinite> {
    check_finite(posterior)?;
    check_finite(input.ranges_seen)?;
    let mut meshes = Vec::new();
    let mut text = String::from("<?xml version=\"1.0\"?>\n<robot name=\"object\">\n");
    let fixed_frame = escaped(input.fixed_frame);
    line(&mut text, 1, &format!("<link name=\"{fixed_frame}\"/>"));
    for link in tree.links() {
        write_link(&mut text, link, posterior, input, &mut meshes);
        write_joint(&mut text, link, tree, posterior, input);
    }
    text.push_str("</robot>\n");
    Ok(Urdf { text, meshes })
}

fn line(text: &mut String, depth: usize, content: &str) {
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{:1$}{content}", "", 2 * depth);
}

fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            c => safe.push(c),
        }
    }
    safe
}

/// Three numbers as URDF has them.
fn triple(v: &Vector3<f64>) -> String {
    format!("{} {} {}", v.x, v.y, v.z)
}

fn origin(at: &Vector3<f64>, rotation: &Matrix3<f64>) -> String {
    // URDF: about the fixed x, y, z, in this order, as here.
    let (roll, pitch, yaw) = Rotation3::from_matrix_unchecked(*rotation).euler_angles();
    format!("<origin xyz=\"{}\" rpy=\"{}\"/>", triple(at), triple(&Vector3::new(roll, pitch, yaw)))
}

fn write_link(
    text: &mut String,
    link: &Link,
    posterior: &ObjectPosterior,
    input: &UrdfInput<'_>,
    meshes: &mut Vec<(String, Vec<u8>)>,
) {
    line(text, 1, &format!("<link name=\"{}\">", link_name(link.label)));
    let hull = input.hulls.get(&link.label).filter(|hull| hull.vertices.iter().all(|v| v.sum().is_finite()));
    let part = posterior.parts.iter().find(|part| part.label == link.label);
    if let (Some(hull), Some(part)) = (hull, part) {
        let mass = part.mass_kg.median;
        // A uniform hull of that mass, its centre where the mass's is.
        let inertia = hull.inertia_per_density * (mass / hull.volume);
        let center = Vector3::from(part.com_in_world_m) - link.origin;
        line(text, 2, "<inertial>");
        line(text, 3, &origin(&center, &Matrix3::identity()));
        line(text, 3, &format!("<mass value=\"{mass}\"/>"));
        let entry = |name: &str, i, j| format!("{name}=\"{}\"", inertia[(i, j)]);
        let entries = [("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2)];
        line(text, 3, &format!("<inertia {}/>", entries.map(|(name, i, j)| entry(name, i, j)).join(" ")));
        line(text, 2, "</inertial>");
    }
    if let Some(hull) = hull {
        let (placed, shape) = geometry(hull, link, input.mesh_folder, meshes);
        for element in ["visual", "collision"] {
            line(text, 2, &format!("<{element}>"));
            line(text, 3, &placed);
            line(text, 3, &format!("<geometry>{shape}</geometry>"));
            line(text, 2, &format!("</{element}>"));
        }
    }
    line(text, 1, "</link>");
}

/// Where the part's shape is in its link, and the shape.
fn geometry(
    hull: &HullProperties,
    link: &Link,
    mesh_folder: Option<&str>,
    meshes: &mut Vec<(String, Vec<u8>)>,
) -> (String, String) {
    let Some(folder) = mesh_folder else {
        let around = hull.least_box();
        let placed = origin(&(around.center - link.origin), &around.axes);
        return (placed, format!("<box size=\"{}\"/>", triple(&around.size)));
    };
    let mut surface = hull.coarse(MESH_VERTICES);
    surface.vertices.iter_mut().for_each(|vertex| *vertex -= link.origin);
    let stl = binary_stl(&surface);
    let name = format!("{}_{:08x}.stl", link_name(link.label), crc32fast::hash(&stl));
    let path = format!("{}/{name}", folder.trim_end_matches('/'));
    meshes.push((name, stl));
    let shape = format!("<mesh filename=\"{}\"/>", escaped(&file_uri(&path)));
    (origin(&Vector3::zeros(), &Matrix3::identity()), shape)
}

/// RFC 8089, with what is not plain percent-encoded.
fn file_uri(path: &str) -> String {
    let mut uri = String::from("file://");
    for byte in path.bytes() {
        if byte.is_ascii_alphanumeric() || b"/-._~".contains(&byte) {
            uri.push(char::from(byte));
        } else {
            let _ = write!(uri, "%{byte:02X}");
        }
    }
    uri
}

fn write_joint(text: &mut String, link: &Link, tree: &LinkTree, posterior: &ObjectPosterior, input: &UrdfInput<'_>) {
    let above = link.parent.map(|parent| &tree.links()[parent]);
    let edge = link.edge.map(|edge| &posterior.edges[edge]);
    let limits = edge.map(|edge| {
        let median = |limit: &Option<Quantity>| limit.as_ref().map(|limit| limit.median);
        let seen = input.ranges_seen.get(&link.label);
        let lower = median(&edge.lower_limit).or(seen.map(|seen| seen.0));
        let upper = median(&edge.upper_limit).or(seen.map(|seen| seen.1));
        // The first frame's position is one that the joint can have.
        (lower.map(|lower| lower.min(0.0)), upper.map(|upper| upper.max(0.0)))
    });
    let (kind, limits) = match (&link.joint, limits) {
        (LinkJoint::Prismatic { .. }, limits) => {
            let (lower, upper) = limits.unwrap_or_default();
            ("prismatic", Some((lower.unwrap_or(-OPEN_WAY), upper.unwrap_or(OPEN_WAY))))
        }
        (LinkJoint::Revolute { .. }, Some((Some(lower), Some(upper)))) => ("revolute", Some((lower, upper))),
        (LinkJoint::Revolute { .. }, _) => ("continuous", None),
        (LinkJoint::Fixed, _) => ("fixed", None),
        (LinkJoint::Floating, _) => ("floating", None),
    };
    line(text, 1, &format!("<joint name=\"{}\" type=\"{kind}\">", joint_name(link.label)));
    let at = link.origin - above.map_or_else(Vector3::zeros, |above| above.origin);
    line(text, 2, &origin(&at, &Matrix3::identity()));
    let parent = above.map_or_else(|| escaped(input.fixed_frame), |above| link_name(above.label));
    line(text, 2, &format!("<parent link=\"{parent}\"/>"));
    line(text, 2, &format!("<child link=\"{}\"/>", link_name(link.label)));
    if let Some(direction) = link.joint.direction() {
        line(text, 2, &format!("<axis xyz=\"{}\"/>", triple(&direction)));
        let (effort, rate) = UNBOUNDED;
        let range = limits.map(|(lower, upper)| format!("lower=\"{lower}\" upper=\"{upper}\" "));
        line(text, 2, &format!("<limit {}effort=\"{effort}\" velocity=\"{rate}\"/>", range.unwrap_or_default()));
        if let Some(edge) = edge {
            let (damping, friction) = (edge.damping.median, edge.friction.median);
            line(text, 2, &format!("<dynamics damping=\"{damping}\" friction=\"{friction}\"/>"));
        }
    }
    line(text, 1, "</joint>");
}

/// Binary STL: 80 bytes of header, the count, then normal, corners and two bytes for each triangle.
fn binary_stl(surface: &Surface) -> Vec<u8> {
    let corner = |index: u32| surface.vertices.get(index as usize).copied().unwrap_or_default();
    let mut stl = vec![0; 80];
    stl.extend((surface.triangles.len() as u32).to_le_bytes());
    for triangle in &surface.triangles {
        let [a, b, c] = triangle.map(corner);
        let normal = (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_default();
        for v in [normal, a, b, c] {
            stl.extend(v.iter().flat_map(|x| (*x as f32).to_le_bytes()));
        }
        stl.extend([0; 2]);
    }
    stl
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::examples;

    fn described(mesh_folder: Option<&str>, fixed_frame: &str) -> Urdf {
        let posterior = examples::door_with_drawer_and_handle();
        let ranges_seen = BTreeMap::from([(Label(2), (-0.002, 1.1)), (Label(3), (-0.3, 0.001))]);
        let hulls = examples::hulls();
        let input = UrdfInput { fixed_frame, hulls: &hulls, ranges_seen: &ranges_seen, mesh_folder };
        urdf(&LinkTree::likeliest(&posterior), &posterior, &input).unwrap()
    }

    #[test]
    fn joints_have_limits_friction_and_damping() {
        let text = described(None, "world").text;
        // Inferred above, seen below; the handle was seen to go nowhere.
        let door = "  <joint name=\"joint_2\" type=\"revolute\">
    <origin xyz=\"-0.30000000000000004 -0.48 0\" rpy=\"0 -0 0\"/>
    <parent link=\"part_4\"/>
    <child link=\"part_2\"/>
    <axis xyz=\"0 0.6 0.8\"/>
    <limit lower=\"-0.002\" upper=\"1.25\" effort=\"1000\" velocity=\"10\"/>
    <dynamics damping=\"2\" friction=\"1.5\"/>
  </joint>\n";
        assert!(text.contains(door), "{text}");
        assert!(text.contains("<joint name=\"joint_3\" type=\"prismatic\">"), "{text}");
        assert!(text.contains("<limit lower=\"-0.3\" upper=\"1.25\""), "{text}");
        assert!(text.contains("<joint name=\"joint_7\" type=\"continuous\">"), "{text}");
        assert!(text.contains("<joint name=\"joint_1\" type=\"fixed\">"), "{text}");
        assert_eq!(text.matches("<box").count(), 10);
    }

    #[test]
    fn what_floats_hangs_on_the_fixed_frame() {
        let posterior = examples::door_with_drawer_and_handle();
        let (hulls, nothing) = (examples::hulls(), BTreeMap::new());
        let input = UrdfInput { fixed_frame: "world", hulls: &hulls, ranges_seen: &nothing, mesh_folder: None };
        let tree = LinkTree::likeliest(&posterior).floating(&[Label(2)].into());
        let text = urdf(&tree, &posterior, &input).unwrap().text;
        let origin = tree.links()[2].origin;
        let door = format!(
            "  <joint name=\"joint_2\" type=\"floating\">
    <origin xyz=\"{}\" rpy=\"0 -0 0\"/>
    <parent link=\"world\"/>
    <child link=\"part_2\"/>
  </joint>\n",
            triple(&origin)
        );
        assert!(text.contains(&door), "{text}");
    }

    #[test]
    fn meshes_are_named_by_content() {
        let Urdf { text, meshes } = described(Some("/var/b o/"), "a<b");
        assert_eq!(meshes.len(), 5);
        for (name, stl) in &meshes {
            assert!(text.contains(&format!("file:///var/b%20o/{name}")), "{text}");
            let count = u32::from_le_bytes(stl[80..84].try_into().unwrap());
            assert_eq!((count, stl.len()), (12, 84 + 12 * 50));
        }
        assert!(text.contains("<link name=\"a&lt;b\"/>") && !text.contains("<box"), "{text}");
    }

    #[test]
    fn the_prior_has_no_joint_that_moves() {
        let posterior = examples::prior();
        let (hulls, nothing) = (examples::hulls(), BTreeMap::new());
        let input = UrdfInput { fixed_frame: "world", hulls: &hulls, ranges_seen: &nothing, mesh_folder: None };
        let text = urdf(&LinkTree::likeliest(&posterior), &posterior, &input).unwrap().text;
        assert_eq!(text.matches("type=\"fixed\"").count(), 5, "{text}");
    }

    #[test]
    fn not_a_number_is_refused() {
        let mut posterior = examples::door_with_drawer_and_handle();
        posterior.edges[3].damping.median = f64::NAN;
        let (hulls, nothing) = (examples::hulls(), BTreeMap::new());
        let input = UrdfInput { fixed_frame: "world", hulls: &hulls, ranges_seen: &nothing, mesh_folder: None };
        let error = urdf(&LinkTree::likeliest(&posterior), &posterior, &input).unwrap_err();
        assert_eq!(error.to_string(), "edges[3].damping.median: NaN, expected a finite number");
    }
}
