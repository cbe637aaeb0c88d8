//! Label maps as NRRD and NIfTI files.

use std::fmt::Write;

use glam::{DMat3, DVec3};

/// Segmentations that highdicom 0.28 writes: a frame of bits for each slice of a segment, and frames of labels.
pub const DICOM_BITS: &[u8] = include_bytes!("written/highdicom-bits.dcm");
pub const DICOM_LABELS: &[u8] = include_bytes!("written/highdicom-labels.dcm");

/// Voxels with labels, and where they are: the step along each axis, and the middle of the first, mm.
pub struct Scan {
    pub sides: [usize; 3],
    pub axes: DMat3,
    pub origin: DVec3,
    pub labels: Vec<u8>,
}

impl Scan {
    /// A scan with the labels that `label` gives for the middles of voxels.
    pub fn of(sides: [usize; 3], axes: DMat3, origin: DVec3, label: impl Fn(DVec3) -> u8) -> Self {
        let mut labels = Vec::new();
        for z in 0..sides[2] {
            for y in 0..sides[1] {
                for x in 0..sides[0] {
                    labels.push(label(origin + axes * DVec3::new(x as f64, y as f64, z as f64)));
                }
            }
        }
        Scan { sides, axes, origin, labels }
    }

    /// The volume of the voxels with a label, mm³.
    pub fn volume(&self, label: u8) -> f64 {
        let voxels = self.labels.iter().filter(|own| **own == label).count();
        voxels as f64 * self.axes.determinant().abs()
    }

    /// As NRRD, with voxels of 2 bytes in the stated order.
    pub fn nrrd(&self, is_big: bool, is_gzip: bool) -> Vec<u8> {
        let [x, y, z] = self.sides;
        let vector = |at: DVec3| format!("({},{},{})", at.x, at.y, at.z);
        let mut text = String::from("NRRD0004\n# made by a test\ntype: short\ndimension: 3\n");
        write!(
            text,
            "space: left-posterior-superior\nsizes: {x} {y} {z}\nspace directions: {} {} {}\nkinds: domain domain domain\n\
             endian: {}\nencoding: {}\nspace origin: {}\nspace units: \"mm\" \"mm\" \"mm\"\nSegment0_Name:=liver: left\n\n",
            vector(self.axes.col(0)),
            vector(self.axes.col(1)),
            vector(self.axes.col(2)),
            if is_big { "big" } else { "little" },
            if is_gzip { "gzip" } else { "raw" },
            vector(self.origin)
        )
        .unwrap();
        let voxel = |label: &u8| {
            let label = u16::from(*label);
            if is_big { label.to_be_bytes() } else { label.to_le_bytes() }
        };
        let voxels: Vec<u8> = self.labels.iter().flat_map(voxel).collect();
        [text.into_bytes(), if is_gzip { gzip(&voxels) } else { voxels }].concat()
    }

    /// As NIfTI-1, with voxels of 4 bytes, scaled by a half.
    pub fn nifti(&self, is_big: bool) -> Vec<u8> {
        let mut file = vec![0; 352];
        let mut put = |at: usize, bytes: Vec<u8>| {
            let bytes: Vec<u8> = if is_big { bytes.into_iter().rev().collect() } else { bytes };
            file[at..at + bytes.len()].copy_from_slice(&bytes);
        };
        put(0, 348_i32.to_le_bytes().to_vec());
        for (number, side) in [3, self.sides[0], self.sides[1], self.sides[2], 1, 1, 1, 1].into_iter().enumerate() {
            put(40 + 2 * number, (side as i16).to_le_bytes().to_vec());
        }
        put(70, 16_i16.to_le_bytes().to_vec());
        put(72, 32_i16.to_le_bytes().to_vec());
        let mut real = |at: usize, number: f64| put(at, (number as f32).to_le_bytes().to_vec());
        real(108, 352.0);
        real(112, 0.5);
        for row in 0..3 {
            real(80 + 4 * row, self.axes.col(row).length());
            for column in 0..3 {
                real(280 + 16 * row + 4 * column, self.axes.col(column)[row]);
            }
            real(292 + 16 * row, self.origin[row]);
        }
        put(254, 2_i16.to_le_bytes().to_vec());
        file[123] = 2;
        file[344..348].copy_from_slice(b"n+1\0");
        let voxel = |label: &u8| {
            let label = 2.0 * f32::from(*label);
            if is_big { label.to_be_bytes() } else { label.to_le_bytes() }
        };
        file.extend(self.labels.iter().flat_map(voxel));
        file
    }
}

/// Compresses to gzip, in two members: the first with a name.
pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let (first, second) = bytes.split_at(bytes.len() / 3);
    let mut file = Vec::new();
    for (part, name) in [(first, &b"a.nii\0"[..]), (second, b"")] {
        file.extend([0x1f, 0x8b, 8, if name.is_empty() { 0 } else { 8 }, 0, 0, 0, 0, 0, 3]);
        file.extend(name);
        file.extend(miniz_oxide::deflate::compress_to_vec(part, 6));
        // Its sum is not read.
        file.extend([0; 4]);
        file.extend((part.len() as u32).to_le_bytes());
    }
    file
}

/// The smallest scan of label 3, for bent files: as NRRD and NIfTI, plain and compressed.
pub fn tiny_files() -> Vec<(&'static str, Vec<u8>)> {
    let inside = |at: DVec3| u8::from(at.distance(DVec3::new(2.0, 1.5, 1.5)) < 1.6) * 3;
    let scan = Scan::of([5, 4, 4], DMat3::IDENTITY, DVec3::ZERO, inside);
    vec![
        ("raw.nrrd", scan.nrrd(false, false)),
        ("gzip.nrrd", scan.nrrd(true, true)),
        ("plain.nii", scan.nifti(false)),
        ("big.nii", scan.nifti(true)),
        ("packed.nii.gz", gzip(&scan.nifti(false))),
        ("bits.dcm", DICOM_BITS.to_vec()),
        ("labels.dcm", DICOM_LABELS.to_vec()),
    ]
}

/// A scan with as many voxels along each axis, and the labels that `label` gives for their numbers.
pub fn scan(side: usize, label: impl Fn(usize) -> u8) -> Scan {
    let labels = (0..side.pow(3)).map(label).collect();
    Scan { sides: [side; 3], axes: DMat3::IDENTITY, origin: DVec3::ZERO, labels }
}

/// A scan without a label, as NIfTI compressed by gzip.
pub fn scan_of_zeros(side: usize) -> Vec<u8> {
    let mut head = scan(1, |_| 0).nifti(false);
    (0..3).for_each(|axis| head[42 + 2 * axis..44 + 2 * axis].copy_from_slice(&(side as i16).to_le_bytes()));
    head.truncate(352);
    // Voxels of a byte.
    head[70] = 2;
    head.resize(352 + side.pow(3), 0);
    gzip(&head)
}

/// A scan of an ellipsoid of label 3 with a lump of label 7.
pub fn small_scan() -> Scan {
    let label = |at: DVec3| {
        let far = (at / DVec3::new(7.0, 6.0, 5.0)).length();
        if at.distance(DVec3::new(2.0, 0.0, 0.0)) < 2.2 { 7 } else { u8::from(far < 1.0) * 3 }
    };
    Scan::of([16, 14, 12], DMat3::IDENTITY, DVec3::new(-7.5, -6.5, -5.5), label)
}
