//! Which tiles of a tissue its springs join, and the points around a sleeping tile that can wake it.

use std::ops::Range;
use std::option;

use super::Places;
use super::sheet::tiles::{EdgeWatch, SheetTiles};
use super::tile_links::TileLinks;
use crate::body::force_field::ForceChange;
use crate::body::model::Model;
use crate::kernel::field::{Field, Layout};
use crate::kernel::real::Real;
use crate::kernel::region::{Marks, sides_of, tile_of};

/// The tiles of a tissue and what joins them.
#[derive(Debug, Clone)]
pub(crate) enum TileGraph {
    /// The tiles of a sheet.
    Sheet(SheetTiles),
    /// The tiles of a tissue whose places are joined in any way, its places, and its layout in memory.
    Linked(Places, Layout),
}

/// The comparisons of sleeping tiles next to awake ones.
#[derive(Debug, Default)]
pub(crate) struct Watches {
    /// On a sheet: one for each side and corner.
    edges: Vec<EdgeWatch>,
    /// On a mesh: the tiles that have springs to awake ones, ascending.
    tiles: Vec<usize>,
}

impl Watches {
    /// Returns whether no tile is watched.
    pub(crate) fn is_empty(&self) -> bool {
        self.edges.is_empty() && self.tiles.is_empty()
    }
}

impl TileGraph {
    /// Returns the tiles of a model.
    pub(crate) fn of(layout: Layout, model: &Model) -> Self {
        match &model.places {
            Places::Sheet(_) => TileGraph::Sheet(SheetTiles::new(layout, model.spring_rows())),
            places => TileGraph::Linked(places.clone(), layout),
        }
    }

    /// Returns the tiles that springs join to a tile.
    pub(crate) fn beside(&self, tile: usize) -> impl Iterator<Item = usize> + '_ {
        let (sheet, links) = self.parts();
        links.flat_map(move |links| links.beside(tile)).chain(sheet.flat_map(move |sheet| sheet.beside(tile)))
    }

    /// Returns the tiles in which springs begin that reach a tile: on a mesh, all that are joined to it.
    pub(crate) fn pulling(&self, tile: usize) -> impl Iterator<Item = usize> + '_ {
        let (sheet, links) = self.parts();
        links.flat_map(move |links| links.beside(tile)).chain(sheet.flat_map(move |sheet| sheet.pulling(tile)))
    }

    /// Returns the tile of a point and those that its springs reach in `sweeps` sweeps; some perhaps twice.
    pub(crate) fn reached(&self, point: [usize; 2], sweeps: usize) -> impl Iterator<Item = usize> + '_ {
        let (sheet, links) = self.parts();
        let linked = links.flat_map(move |links| {
            let tile = tile_of(self.layout(), point);
            links.beside(tile).chain([tile])
        });
        linked.chain(sheet.flat_map(move |sheet| sheet.reached(point, sweeps)))
    }

    fn layout(&self) -> &Layout {
        match self {
            TileGraph::Sheet(sheet) => &sheet.layout,
            TileGraph::Linked(_, layout) => layout,
        }
    }

    /// Returns the one that there is, as iterators of at most one.
    fn parts(&self) -> (option::IntoIter<&SheetTiles>, option::IntoIter<&TileLinks>) {
        match self {
            TileGraph::Sheet(sheet) => (Some(sheet).into_iter(), None.into_iter()),
            TileGraph::Linked(places, _) => (None.into_iter(), places.links().into_iter()),
        }
    }

    /// Returns the number of positions that all tiles remember together, three values for each point.
    pub(crate) fn remembered_values(&self, tiles: usize) -> usize {
        match self {
            TileGraph::Sheet(_) => SheetTiles::remembered(tiles).start,
            TileGraph::Linked(places, _) => 3 * places.links().map_or(0, TileLinks::watched),
        }
    }

    /// Returns the place of the positions that a tile remembers.
    pub(crate) fn remembered(&self, tile: usize) -> Range<usize> {
        match self {
            TileGraph::Sheet(_) => SheetTiles::remembered(tile),
            TileGraph::Linked(places, _) => places.links().map_or(0..0, |links| {
                let (around, first) = links.around(tile);
                3 * first..3 * (first + around.len())
            }),
        }
    }

    /// Stores where the points around a tile are.
    pub(crate) fn remember<T: Real>(&self, tile: usize, u: &Field<T>, snapshots: &mut [T]) {
        match self {
            TileGraph::Sheet(sheet) => sheet.remember(tile, u, snapshots),
            TileGraph::Linked(places, layout) => {
                places.links().into_iter().for_each(|links| links.remember(layout, tile, u, snapshots));
            }
        }
    }

    /// Makes `watches` those of the sleeping tiles next to the awake ones.
    pub(crate) fn watch(&self, awake: &Marks, watches: &mut Watches) {
        let Watches { edges, tiles } = watches;
        edges.clear();
        tiles.clear();
        match self {
            TileGraph::Sheet(sheet) => awake.members.iter().for_each(|tile| sheet.watch(*tile, awake, edges)),
            TileGraph::Linked(..) => {
                let beside = awake.members.iter().flat_map(|tile| self.beside(*tile));
                tiles.extend(beside.filter(|other| !awake.has[*other]));
                tiles.sort_unstable();
                tiles.dedup();
            }
        }
    }

    /// Returns the watched tiles whose neighbours have moved by more than `far`: points next to a tile since it fell
    /// asleep (`snapshots`), and on a sheet also points whose motion reaches it in the `sweeps` of a substep, in the
    /// substep before. On a mesh only points in the tiles `of` are looked at.
    pub(crate) fn woken<T: Real>(
        &self,
        watches: &Watches,
        [u, d]: [&Field<T>; 2],
        (snapshots, far): (&[T], T),
        sweeps: usize,
        of: impl Fn(usize) -> bool,
    ) -> Vec<usize> {
        match self {
            TileGraph::Sheet(sheet) => {
                let moved = |watch: &&EdgeWatch| sheet.has_moved(watch, [u, d], snapshots, sweeps, far);
                watches.edges.iter().filter(moved).map(|watch| watch.tile).collect()
            }
            TileGraph::Linked(places, layout) => {
                let moved = |tile: &&usize| {
                    let compared = (u, snapshots, far);
                    places.links().is_some_and(|links| links.has_moved(layout, **tile, &of, compared))
                };
                watches.tiles.iter().filter(moved).copied().collect()
            }
        }
    }

    /// Calls `changed` with each sleeping tile on whose points the tools' force may have changed, and a bound of that
    /// change, N: on a mesh divided by the smallest relative K″ of the tile. With `everywhere`, these are all tiles.
    pub(crate) fn force_changes(
        &self,
        change: &ForceChange,
        spacing_m: f64,
        everywhere: bool,
        awake: &[bool],
        mut changed: impl FnMut(usize, f64),
    ) {
        match self {
            TileGraph::Sheet(sheet) => sheet.force_changes(change, spacing_m, everywhere, awake, changed),
            TileGraph::Linked(places, layout) => {
                for tile in (0..awake.len()).filter(|tile| !awake[*tile]) {
                    changed(tile, most_change_n(places, change, layout, tile));
                }
            }
        }
    }
}

/// Returns an upper bound of the change of force on any point of a tile, N; on a mesh divided by the smallest relative K″ of
/// the tile.
fn most_change_n(places: &Places, change: &ForceChange, layout: &Layout, tile: usize) -> f64 {
    match places {
        Places::Sheet(_) => f64::INFINITY,
        Places::Surface(places) => change.most_n(places.box_of(tile)) / places.least_pull(tile),
        Places::Solid(places) => change.most_n(&places.box_of(&sides_of(layout, tile))),
    }
}
