//! The scenes of the error benchmark: a scene that is built in, with assignments, and a script. All jumps are at multiples
//! of 0.04 s, which are whole steps at every rate from 125 Hz on.
#![allow(unreachable_pub)]

/// A scene and its script.
pub struct Case {
    /// A short name.
    pub name: &'static str,
    /// Its purpose.
    pub about: &'static str,
    /// The scene that is built in.
    pub scene: &'static str,
    /// Assignments as for `--set`, on that.
    pub assignments: &'static [&'static str],
    /// Forces and tools, as in a script.
    pub acts: &'static str,
    /// Points where displacement and force are compared.
    pub sample_points: &'static str,
}

impl Case {
    /// The complete script.
    pub fn script(&self) -> String {
        format!("duration_s = 0.8\nsample_every_s = 0.04\nsample_points = {}\n{}", self.sample_points, self.acts)
    }

    /// The assignments, followed by `more`.
    pub fn with(&self, more: &[String]) -> Vec<String> {
        self.assignments.iter().map(|text| (*text).to_owned()).chain(more.iter().cloned()).collect()
    }
}

/// The cases to measure.
pub const CASES: [Case; 9] = [
    Case {
        name: "gentle",
        about: "the paper's sheet, 0.3 N over several points, which grow and then stay",
        scene: "paper",
        assignments: &[],
        sample_points: "[[15, 15], [16, 15], [17, 17], [20, 15]]",
        acts: r#"
            [[force]]
            point = [15, 15]
            force_n = [0.1, 0.0, -0.3]
            falloff_per_m = 15.0
            falloff_offset = 0.0
            profile = { type = "ramp", from_s = 0.0, to_s = 0.2 }
        "#,
    },
    Case {
        name: "paper",
        about: "the paper's sheet, a sudden force of 3 N straight down on its centre, released after 0.4 s",
        scene: "paper",
        assignments: &[],
        sample_points: "[[15, 15], [16, 15], [17, 17], [20, 15]]",
        acts: r#"
            [[force]]
            point = [15, 15]
            force_n = [0.0, 0.0, -3.0]
            falloff_per_m = 150.0
            falloff_offset = 0.0
            profile = { type = "pulse", on_s = 0.0, off_s = 0.4 }
        "#,
    },
    Case {
        name: "stiff",
        about: "k = 1e4 N/m on 15 × 15 points, a sudden oblique force of 0.5 N that stays",
        scene: "paper",
        assignments: &["sheet.points=[15, 15]", "springs.stiffness_n_per_m=1e4"],
        sample_points: "[[7, 7], [8, 7], [9, 9], [3, 7]]",
        acts: r#"
            [[force]]
            point = [7, 7]
            force_n = [0.2, 0.0, -0.5]
            falloff_per_m = 30.0
            falloff_offset = 0.0
            profile = { type = "constant" }
        "#,
    },
    Case {
        name: "overdamped",
        about: "points of 0.1 g, so that C·dt/m = 5 at 1 ms; an oblique force of 0.5 N, released after 0.4 s",
        scene: "paper",
        assignments: &["sheet.points=[19, 19]", "sheet.point_mass_kg=1e-4"],
        sample_points: "[[9, 9], [10, 9], [11, 11], [14, 9]]",
        acts: r#"
            [[force]]
            point = [9, 9]
            force_n = [0.3, 0.0, -0.5]
            falloff_per_m = 60.0
            falloff_offset = 0.0
            profile = { type = "pulse", on_s = 0.0, off_s = 0.4 }
        "#,
    },
    Case {
        name: "undamped",
        about: "C = 0 on 15 × 15 points: the sheet swings after a push of 0.08 s (the paper's scheme is then central differences)",
        scene: "paper",
        assignments: &["sheet.points=[15, 15]", "damping.coefficient_n_s_per_m=0"],
        sample_points: "[[7, 7], [8, 7], [9, 9], [3, 7]]",
        acts: r#"
            [[force]]
            point = [7, 7]
            force_n = [0.1, 0.0, -0.2]
            falloff_per_m = 15.0
            falloff_offset = 0.0
            profile = { type = "pulse", on_s = 0.0, off_s = 0.08 }
        "#,
    },
    Case {
        name: "moving",
        about: "1 N stroked across the paper's sheet at 0.9 m/s, between the points",
        scene: "paper",
        assignments: &[],
        sample_points: "[[8, 11], [13, 12], [19, 13], [15, 15]]",
        acts: r#"
            [[force]]
            path = { from_m = [0.13, 0.35], velocity_m_per_s = [0.9, 0.11] }
            force_n = [0.0, 0.0, -1.0]
            falloff_per_m = 60.0
            falloff_offset = 0.0
            profile = { type = "ramp", from_s = 0.0, to_s = 0.2 }
        "#,
    },
    Case {
        name: "tissue",
        about: "k = 25 K″ with bending on 15 × 15 points; a grasped point is pressed in, moved aside and back",
        scene: "paper",
        assignments: &[
            "sheet.points=[15, 15]",
            "sheet.spacing_m=0.05",
            "springs.stiffness_n_per_m=125",
            "springs.bending=true",
            "damping.coefficient_n_s_per_m=0.3",
        ],
        sample_points: "[[7, 7], [8, 7], [8, 8], [3, 7]]",
        acts: r#"
            [[tool]]
            point = [7, 7]
            moves = [
                { from_s = 0.0, to_s = 0.2, by_m = [0.0, 0.0, -0.05] },
                { from_s = 0.24, to_s = 0.44, by_m = [0.03, 0.015, 0.0] },
                { from_s = 0.52, to_s = 0.6, by_m = [-0.03, -0.015, 0.05] },
            ]
        "#,
    },
    Case {
        name: "gallbladder",
        about: "`gallbladder` with edges of 3 mm; a sudden oblique force of 0.5 N over several vertices, released after 0.4 s",
        scene: "gallbladder",
        assignments: &["mesh.organ.edge_m=0.003"],
        sample_points: "[739, 626, 656, 738]",
        acts: r#"
            [[force]]
            vertex = 739
            force_n = [-0.1, 0.4, -0.3]
            falloff_per_m = 200.0
            falloff_offset = 0.0
            profile = { type = "pulse", on_s = 0.0, off_s = 0.4 }
        "#,
    },
    Case {
        name: "liver-organ",
        about: "`liver-organ` with edges of 6 mm; 1 N on a vertex of its larger lump, which grows and then stays",
        scene: "liver-organ",
        assignments: &["mesh.organ.edge_m=0.006"],
        sample_points: "[1425, 1359, 1394, 1426]",
        acts: r#"
            [[force]]
            vertex = 1425
            force_n = [0.2, 0.3, -1.0]
            falloff_per_m = 150.0
            falloff_offset = 0.0
            profile = { type = "ramp", from_s = 0.0, to_s = 0.2 }
        "#,
    },
];
