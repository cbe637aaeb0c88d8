// The wound of a surface as drawn: the parts of the triangles that blades have cut, a dark line along each lip, and dark tissue between
// the lips. What is cut of the surface itself is hidden there. All vertices follow those of the surface, so a wound that gapes opens.
//
// A picture takes in at most `CUTS_PER_PICTURE` cut triangles, and the rest of a large wound comes with the next ones.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage } from "three";
import { type Cut, type Field, mixed, type Wound, type WoundChange } from "palpate";

/** Cut triangles, or cells of a refined sheet, that one picture takes in at most. */
export const CUTS_PER_PICTURE = 512;
/** A wound has at most this many drawn vertices, so that it follows the surface within a picture; what is beyond stays closed. */
export const MAX_SLOTS = 1 << 16;
/** Depth of the tissue between the lips, in distances of mass points. */
const DEPTH = 0.5;
/** Lips that are farther apart than this, in distances of mass points, belong to pieces: no tissue is between them. */
const APART = 4;
/** How much darker a lip is than the surface. */
const LIP_LIGHT = 0.62;
/** Initial numbers of vertices and triangles; they double when they do not suffice. */
const ROOM = 256;

/** What a wound needs to know of its surface. */
export interface WoundedSurface {
  /** Numbers of vertices and triangles of the mesh, in the server's order. */
  readonly vertexCount: number;
  readonly triangleCount: number;
  /** Distance of neighbouring mass points, m. */
  readonly pointsApartM: number;
  readonly geometry: BufferGeometry;
  /** Returns the drawn vertex that a vertex of the mesh is. */
  drawnVertex(vertex: number): number;
  /** Returns coordinate `c` of a vertex at rest, m. */
  restOf(vertex: number, c: number): number;
  /** Where the surface within cuts is: its displacements are in the last rows of the field. */
  readonly field: Field;
  /** Hides triangles of the mesh, or shows all again. */
  hide(first: number, count: number): void;
  showAll(): void;
}

/** Attributes of a surface that its material needs, and their sizes. */
const SIZES: Record<string, number> = { position: 3, normal: 3, open: 1, burn: 1, uv: 2, rest: 3, restNormal: 3, inner: 1 };

export class ShownWound {
  /** The parts of cut triangles, the tissue between the lips, and lines along these. */
  readonly parts = new BufferGeometry();
  readonly bed = new BufferGeometry();
  readonly lips = new BufferGeometry();
  /** The surface within the cuts of a solid. */
  readonly cutSurface = new BufferGeometry();
  private isCutSurfaceStale = false;
  /** The most cut triangles that one picture took in; for tests. */
  mostAtOnce = 0;
  private wound: Wound | undefined;
  private waiting: Cut[] = [];
  /** Drawn vertices: the number of each in the wound's numbering. */
  private readonly vertexOf: number[] = [];
  private readonly slotOf = new Map<number, number>();
  /** Places of the drawn triangles of each cut, and free ones; each triangle has a place for a line, too. */
  private readonly placesOf = new Map<number, number[]>();
  private readonly free: number[] = [];
  private places = 0;
  private triangleRoom = 0;
  private slotRoom = 0;
  private isStale = false;

  constructor(private readonly surface: WoundedSurface) {}

  /** Number of shown cuts, of those that wait for the next pictures, and of drawn faces within the cuts of a solid. */
  get count(): { shown: number; waiting: number; cutFaces: number } {
    const cutFaces = (this.cutSurface.index?.count ?? 0) / 6;
    return { shown: this.placesOf.size, waiting: this.waiting.length, cutFaces };
  }

  /** Shows what has changed of a wound. */
  take(wound: Wound, { isNew, cuts, hasNewCutSurface }: WoundChange): void {
    if (isNew) this.clear();
    this.wound = wound;
    this.isCutSurfaceStale ||= hasNewCutSurface;
    // Of several with the same first triangle, the last one counts.
    this.waiting = [...new Map([...this.waiting, ...cuts].map((cut) => [cut.first, cut])).values()];
  }

  private clear(): void {
    if (this.places > 0) this.surface.showAll();
    [this.waiting, this.places, this.vertexOf.length, this.free.length] = [[], 0, 0, 0];
    this.slotOf.clear();
    this.placesOf.clear();
    for (const geometry of [this.parts, this.bed, this.lips, this.cutSurface]) geometry.setDrawRange(0, 0);
  }

  /** The surface has other drawn vertices. */
  rebuild(): void {
    for (const [first, cut] of this.wound?.cuts ?? []) if (this.placesOf.has(first)) this.surface.hide(first, cut.count);
    for (let slot = 0; slot < this.vertexOf.length; slot++) this.dress(slot);
    this.isStale = true;
  }

  /** Takes in a part of what waits, and follows the surface if that moved. Returns whether more waits. */
  refresh(hasMoved: boolean): boolean {
    const now = this.waiting.splice(0, CUTS_PER_PICTURE);
    this.mostAtOnce = Math.max(this.mostAtOnce, now.length);
    for (const cut of now) this.show(cut);
    if (now.length > 0) this.parts.index!.needsUpdate = this.lips.index!.needsUpdate = true;
    if (this.vertexOf.length > 0 && (hasMoved || now.length > 0 || this.isStale)) this.follow();
    if (this.isCutSurfaceStale) this.buildCutSurface();
    else if (hasMoved) this.followCutSurface();
    return this.waiting.length > 0;
  }

  private show({ first, count, corners }: Cut): void {
    const { wound } = this;
    const added = corners.filter((corner) => !this.slotOf.has(corner)).length;
    if (!wound || this.vertexOf.length + added > MAX_SLOTS) return;
    const places = this.placesOf.get(first) ?? [];
    for (const place of places) this.write(place, [0, 0, 0], false);
    this.free.push(...places.splice(0));
    this.surface.hide(first, count);
    for (let k = 0; k < corners.length; k += 3) {
      const [a, b, c] = [corners[k]!, corners[k + 1]!, corners[k + 2]!];
      const isLip = Math.max(b, c) >= wound.vertexCount;
      const slots = [this.slot(a), this.slot(b), this.slot(c)] as const;
      const place = this.free.pop() ?? this.places++;
      this.write(place, slots, isLip);
      places.push(place);
    }
    this.placesOf.set(first, places);
  }

  /** Writes a triangle, and the line between its second and third corner if that is a lip. */
  private write(place: number, [a, b, c]: readonly [number, number, number], isLip: boolean): void {
    if (place >= this.triangleRoom) {
      this.triangleRoom = Math.max(ROOM, 2 * this.triangleRoom);
      for (const [geometry, size] of [[this.parts, 3], [this.lips, 2]] as const) {
        const grown = new Uint32Array(size * this.triangleRoom);
        grown.set((geometry.index?.array as Uint32Array | undefined) ?? []);
        geometry.dispose();
        geometry.setIndex(new BufferAttribute(grown, 1).setUsage(DynamicDrawUsage));
      }
      this.bed.dispose();
      this.bed.setIndex(this.parts.index);
    }
    this.parts.index!.set([a, b, c], 3 * place);
    this.lips.index!.set(isLip ? [b, c] : [0, 0], 2 * place);
    this.parts.setDrawRange(0, 3 * this.places);
    this.bed.setDrawRange(0, 3 * this.places);
    this.lips.setDrawRange(0, 2 * this.places);
  }

  /** Returns the drawn vertex of a vertex of the wound or of the mesh. */
  private slot(vertex: number): number {
    const known = this.slotOf.get(vertex);
    if (known !== undefined) return known;
    const slot = this.vertexOf.push(vertex) - 1;
    this.slotOf.set(vertex, slot);
    if (slot >= this.slotRoom) this.grow();
    this.dress(slot);
    return slot;
  }

  private grow(): void {
    this.slotRoom = Math.max(ROOM, 2 * this.slotRoom);
    const grown = (geometry: BufferGeometry, name: string, size: number) => {
      const values = new Float32Array(size * this.slotRoom);
      values.set((geometry.getAttribute(name)?.array) ?? []);
      geometry.setAttribute(name, new BufferAttribute(values, size).setUsage(DynamicDrawUsage));
    };
    for (const geometry of [this.parts, this.bed, this.lips]) geometry.dispose();
    for (const [name, size] of Object.entries(SIZES)) if (this.surface.geometry.hasAttribute(name)) grown(this.parts, name, size);
    grown(this.bed, "position", 3);
    this.lips.setAttribute("position", this.parts.getAttribute("position"));
  }

  /** Returns a vertex's place in the mesh: a vertex of the mesh is its own host. */
  private lip(slot: number): { host: number; second: number; third: number; secondPart: number; thirdPart: number } {
    const vertex = this.vertexOf[slot]!;
    const lip = this.wound?.vertices[vertex - this.surface.vertexCount];
    return lip ?? { host: vertex, second: vertex, third: vertex, secondPart: 0, thirdPart: 0 };
  }

  /** Gives a drawn vertex what does not move: its place in the texture, and at rest. */
  private dress(slot: number): void {
    this.mix(slot, ["uv", "rest", "restNormal", "burn"]);
  }

  /** The surface is burnt in another way. */
  showBurns(): void {
    for (let slot = 0; slot < this.vertexOf.length; slot++) this.mix(slot, ["burn"]);
  }

  /** Gives a drawn vertex its part of attributes of the surface. */
  private mix(slot: number, names: readonly string[]): void {
    const { surface } = this;
    const lip = this.lip(slot);
    const drawn = { ...lip, host: surface.drawnVertex(lip.host), second: surface.drawnVertex(lip.second), third: surface.drawnVertex(lip.third) };
    for (const name of names) {
      const [to, from] = [this.parts.getAttribute(name), surface.geometry.getAttribute(name)];
      if (!to || !from) continue;
      for (let c = 0; c < to.itemSize; c++) to.array[to.itemSize * slot + c] = mixed(drawn, from.array, to.itemSize, c);
      to.needsUpdate = true;
    }
  }

  /** Puts all vertices where the surface is: each keeps its distance at rest from its host. Between the lips, the tissue is in the middle. */
  private follow(): void {
    const { surface, parts, bed } = this;
    const [position, normal, open] = ["position", "normal", "open"].map((name) => surface.geometry.getAttribute(name).array) as [Float32Array, Float32Array, Float32Array];
    const inner = surface.geometry.getAttribute("inner")?.array as Float32Array | undefined;
    const to = (name: string) => parts.getAttribute(name).array as Float32Array;
    const [ownPosition, ownNormal, ownOpen] = [to("position"), to("normal"), to("open")];
    const bedPosition = bed.getAttribute("position").array as Float32Array;
    const depthM = DEPTH * surface.pointsApartM;
    for (let slot = 0; slot < this.vertexOf.length; slot++) {
      const { host, second, third, secondPart, thirdPart } = this.lip(slot);
      const isLip = secondPart !== 0 || thirdPart !== 0 || host !== second;
      const h = surface.drawnVertex(host);
      const ends = thirdPart === 0 ? [host, second] : [host, second, third];
      const moved = (vertex: number, c: number) => position[3 * surface.drawnVertex(vertex) + c]! - surface.restOf(vertex, c);
      const apart = (vertex: number) => Math.hypot(...[0, 1, 2].map((c) => moved(vertex, c) - moved(host, c)));
      const bedEnds = isLip && Math.max(...ends.map(apart)) > APART * surface.pointsApartM ? [host] : ends;
      for (let c = 0; c < 3; c++) {
        const hostM = surface.restOf(host, c);
        const restM = hostM + secondPart * (surface.restOf(second, c) - hostM) + (thirdPart === 0 ? 0 : thirdPart * (surface.restOf(third, c) - hostM));
        ownPosition[3 * slot + c] = restM + position[3 * h + c]! - hostM;
        ownNormal[3 * slot + c] = normal[3 * h + c]!;
        let movedM = 0;
        for (const end of bedEnds) movedM += moved(end, c);
        bedPosition[3 * slot + c] = restM + movedM / bedEnds.length - depthM * normal[3 * h + c]!;
      }
      const light = isLip ? LIP_LIGHT : 1;
      ownOpen[slot] = light * open[h]!;
      if (inner) to("inner")[slot] = light * inner[h]!;
    }
    for (const name of ["position", "normal", "open", "inner"]) {
      const attribute = parts.getAttribute(name);
      if (attribute) attribute.needsUpdate = true;
    }
    bed.getAttribute("position").needsUpdate = true;
    this.isStale = false;
  }

  /** Makes the surface within the cuts anew, all at once: its faces are those of cells, of which a cut has some thousands at most. */
  private buildCutSurface(): void {
    this.isCutSurfaceStale = false;
    const { cutRestM, cutFaces } = this.wound ?? { cutRestM: [], cutFaces: new Map<number, readonly number[]>() };
    const index = new Uint32Array(6 * cutFaces.size);
    let at = 0;
    for (const [a, b, c, d] of cutFaces.values()) {
      index.set([a!, b!, c!, a!, c!, d!], at);
      at += 6;
    }
    this.cutSurface.dispose();
    this.cutSurface.setIndex(new BufferAttribute(index, 1));
    this.cutSurface.setAttribute("rest", new BufferAttribute(Float32Array.from(cutRestM), 3));
    this.cutSurface.setAttribute("position", new BufferAttribute(Float32Array.from(cutRestM), 3).setUsage(DynamicDrawUsage));
    this.cutSurface.setDrawRange(0, at);
    this.followCutSurface();
  }

  /** Puts the surface within the cuts where the newest frame has it. */
  private followCutSurface(): void {
    const rest = this.wound?.cutRestM ?? [];
    const position = this.cutSurface.getAttribute("position") as BufferAttribute | undefined;
    if (rest.length === 0 || !position || position.array.length !== rest.length) return;
    const { displacementM, nx, ny, cutRows } = this.surface.field;
    const first = 3 * (nx - cutRows) * ny;
    for (let k = 0; k < rest.length; k++) position.array[k] = rest[k]! + displacementM[first + k]!;
    position.needsUpdate = true;
  }

  dispose(): void {
    for (const geometry of [this.parts, this.bed, this.lips, this.cutSurface]) geometry.dispose();
  }
}
