//! NumPy arrays over memory that was filled here, without a copy.
//!
//! An array asks an object for `__array_interface__`, which says where its numbers are, and keeps the object alive.
//! So neither this crate nor its users need to be compiled against NumPy.

use glam::DVec3;
use palpate_tissue::scene::record::Point;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::error::wrong;

/// A type of number that NumPy has.
pub(crate) trait Number: Send + Sync + 'static {
    /// NumPy's code for its kind and its size in bytes.
    const KIND: &'static str;
}

macro_rules! numbers {
    ($($Type:ty = $kind:literal),*) => { $(impl Number for $Type { const KIND: &'static str = $kind; })* };
}

numbers!(f64 = "f8", f32 = "f4", u64 = "u8", u32 = "u4", i64 = "i8", bool = "b1");

/// The memory of an array, kept alive by it.
#[pyclass(frozen)]
pub(crate) struct Memory {
    /// Only the array reads and writes it from now on.
    _owner: Box<dyn Send + Sync>,
    address: usize,
    kind: &'static str,
    shape: Vec<usize>,
}

#[pymethods]
impl Memory {
    #[getter]
    fn __array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let order = if cfg!(target_endian = "little") { '<' } else { '>' };
        let interface = PyDict::new(py);
        interface.set_item("version", 3)?;
        interface.set_item("typestr", format!("{order}{}", self.kind))?;
        interface.set_item("shape", PyTuple::new(py, &self.shape)?)?;
        interface.set_item("data", (self.address, false))?;
        Ok(interface)
    }
}

/// Returns numbers as an array of this shape, whose product must be their count.
fn array<'py, T: Number>(py: Python<'py>, mut numbers: Vec<T>, shape: Vec<usize>) -> PyResult<Bound<'py, PyAny>> {
    debug_assert_eq!(numbers.len(), shape.iter().product::<usize>());
    // Moving the vector does not move the numbers.
    let address = numbers.as_mut_ptr().expose_provenance();
    let memory = Memory { _owner: Box::new(numbers), address, kind: T::KIND, shape };
    py.import("numpy")?.call_method1("asarray", (memory,))
}

/// Returns numbers as a one-dimensional array.
pub(crate) fn column<'py, T: Number>(py: Python<'py>, numbers: Vec<T>) -> PyResult<Bound<'py, PyAny>> {
    let shape = vec![numbers.len()];
    array(py, numbers, shape)
}

/// Number of values in a point's record: displacement, velocity, and six forces, each with three components.
pub(crate) const OF_POINT: usize = 24;

/// Number of values in a tool's record: place, displacement, force, each with three components.
pub(crate) const OF_TOOL: usize = 9;

/// Appends a point's record; NaN for a force that does not exist.
pub(crate) fn add_point(into: &mut Vec<f64>, point: &Point) {
    let constraint_n = point.constraint_n.unwrap_or([f64::NAN; 3]);
    for vector in [
        &point.displacement_m,
        &point.velocity_m_per_s,
        &point.spring_n,
        &point.anchor_n,
        &point.damping_n,
        &point.applied_n,
        &point.reaction_n,
        &constraint_n,
    ] {
        into.extend_from_slice(vector);
    }
}

/// Returns vectors as an array with one per row.
pub(crate) fn rows<'py>(py: Python<'py>, numbers: Vec<f64>) -> PyResult<Bound<'py, PyAny>> {
    shaped(py, numbers, &[3])
}

/// Returns numbers as an array whose rows have this shape.
pub(crate) fn shaped<'py, T: Number>(py: Python<'py>, numbers: Vec<T>, row: &[usize]) -> PyResult<Bound<'py, PyAny>> {
    let of_row: usize = row.iter().product();
    let mut shape = vec![numbers.len().checked_div(of_row).unwrap_or(0)];
    shape.extend_from_slice(row);
    array(py, numbers, shape)
}

/// Returns numbers as an array of records of a type of `palpate._arrays`, in this shape.
pub(crate) fn records<'py>(
    py: Python<'py>,
    numbers: Vec<f64>,
    dtype: &str,
    shape: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    let dtype = py.import("palpate._arrays")?.getattr(dtype)?;
    column(py, numbers)?.call_method1("view", (dtype,))?.call_method1("reshape", (PyTuple::new(py, shape)?,))
}

/// Writes vectors into an array of the caller. Refuses an array of another shape.
pub(crate) fn write_into(py: Python<'_>, out: &Bound<'_, PyAny>, numbers: Vec<f64>) -> PyResult<()> {
    let shape: Vec<usize> = out.getattr("shape").and_then(|shape| shape.extract()).unwrap_or_default();
    let expected = [numbers.len() / 3, 3];
    if shape != expected {
        return Err(wrong("out", format!("must be an array of shape {expected:?}, but is of {shape:?}")));
    }
    py.import("numpy")?.call_method1("copyto", (out, rows(py, numbers)?)).map(drop)
}

/// Reads a vector of three numbers.
pub(crate) fn vector(field: &str, value: &Bound<'_, PyAny>) -> PyResult<DVec3> {
    let found: PyResult<[f64; 3]> = value.extract();
    found.map(DVec3::from_array).map_err(|_| wrong(field, "must be three numbers, x, y and z"))
}
