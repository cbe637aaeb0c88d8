// Shading of tissue, table and instruments. All have the same lamp and sky, and use the true normal. The same shaders
// run with and without a graphics processor, and only those for one picture are compiled.

import { Color, DoubleSide, ShaderMaterial, type Texture, Vector2, Vector3, Vector4 } from "three";

/** Number of tools that cast a shadow: those of both hands. Each that does costs time at every pixel. */
export const SHADOWS = 2;

/** Uniforms that the shaders share; `Stage` and `ToolMark` write them. */
export const light = {
  /** Direction to the lamp. */
  lamp: { value: new Vector3(0, 0, 1) },
  /** Centre of each tool's tip, m, and its radius; 0 for none. */
  tips: { value: Array.from({ length: SHADOWS }, () => new Vector4(0, 0, 0, 0)) },
  /** Far end of each tool's shaft, and its radius, m. */
  shafts: { value: Array.from({ length: SHADOWS }, () => new Vector4(0, 0, 0, 0)) },
  /**
   * Rings on the tissue, where it intersects a sphere: centre and radius, m; 0 for none. The last ring marks the
   * target of the keys.
   */
  rings: { value: Array.from({ length: SHADOWS + 1 }, () => new Vector4(0, 0, 0, 0)) },
  ink: { value: new Color() },
};

/** Soft shadows of capsules (after Inigo Quilez), and the darkening near a tip. */
const SHADOW = `
uniform vec3 lamp;
uniform vec4 tips[${SHADOWS}];
uniform vec4 shafts[${SHADOWS}];
float shadow(vec3 from, vec4 tip, vec4 end) {
  vec3 along = end.xyz - tip.xyz;
  vec3 to = from - tip.xyz;
  float a = dot(along, along), b = dot(along, lamp), c = dot(to, lamp), d = dot(to, along);
  vec2 t = vec2(b * d - a * c, d - b * c) / max(a - b * b, 1e-12);
  t = vec2(max(t.x, 1e-9), clamp(t.y, 0.0, 1.0));
  vec3 apart = from + lamp * t.x - tip.xyz - along * t.y;
  float radius = mix(tip.w, end.w, smoothstep(0.0, 0.12, t.y));
  float edge = 0.35 * radius + 0.16 * t.x;
  return smoothstep(-edge, edge, length(apart) - radius);
}
float lit(vec3 at) {
  float share = 1.0;
  for (int i = 0; i < ${SHADOWS}; i++) if (tips[i].w > 0.0) share *= shadow(at, tips[i], shafts[i]);
  return share;
}
float contact(vec3 at) {
  float open = 1.0;
  for (int i = 0; i < ${SHADOWS}; i++) if (tips[i].w > 0.0) {
    vec3 to = (at - tips[i].xyz) / tips[i].w;
    open *= 1.0 - 0.75 * exp(0.9 - 0.9 * dot(to, to));
  }
  return max(open, 0.0);
}`;

/**
 * Sheets: seen from above, with an image that lies flat on them. Beyond the edge the image continues mirrored, and
 * soon changes to another part of itself, so that the mirroring is not noticeable.
 */
const SHEET = `
float beyond() {
  vec2 past = max(abs(vUv - 0.5) - 0.5, 0.0);
  return max(past.x, past.y);
}
vec3 image() {
  vec3 other = texture2D(map, mat2(0.34, 0.94, -0.94, 0.34) * vUv + 0.37).rgb;
  return mix(texture2D(map, vUv).rgb, other, smoothstep(0.0, 0.035, beyond()));
}
float openness(float facing) { return vOpen; }
bool isTurned() { return true; }
// The round edge would show the lamp as a white dot.
float glints(vec3 n) { return 1.0 - smoothstep(-0.02, 0.0, max(abs(vUv.x - 0.5), abs(vUv.y - 0.5)) - 0.5); }
float within(float open) { return 0.0; }
float window_(vec3 seen, vec3 lamp) { return 0.0; }`;

/**
 * Bodies: the image uses the file's coordinates, or is projected from three sides if there are none. Both sides have
 * their own ambient light, and the interior, such as that of a tube, is lit by a lamp beside the eye.
 */
const BODY = `
uniform float projected;
uniform float period;
uniform float closed;
varying vec3 vRest;
varying vec3 vRestNormal;
varying float vInner;
vec3 image() {
  if (projected < 0.5) return texture2D(map, vUv).rgb;
  vec3 lie = pow(abs(normalize(vRestNormal)), vec3(5.0));
  lie /= lie.x + lie.y + lie.z;
  // Rotated, so that the mirror images on the three sides do not line up.
  vec3 at = vRest / period;
  vec3 a = texture2D(map, mat2(0.94, 0.34, -0.34, 0.94) * at.yz + 0.21).rgb;
  vec3 b = texture2D(map, mat2(0.77, -0.64, 0.64, 0.77) * at.zx + 0.47).rgb;
  vec3 c = texture2D(map, mat2(0.87, 0.49, -0.49, 0.87) * at.xy + 0.73).rgb;
  return a * lie.x + b * lie.y + c * lie.z;
}
// At the outline of a fold, slivers of its other side become visible: there, the brighter value of both sides counts.
float openness(float facing) {
  if (closed > 0.5) return vOpen;
  float own = gl_FrontFacing ? vOpen : vInner;
  return mix(max(vOpen, vInner), own, smoothstep(0.02, 0.15, abs(facing)));
}
bool isTurned() { return closed < 0.5; }
// Where the curvature is large, the lamp would appear as a white dot. Curvature times the body's size is 3.5 on a
// ball.
float glints(vec3 n) {
  float bend = (length(dFdx(n)) + length(dFdy(n))) / max(length(dFdx(vAt)) + length(dFdy(vAt)), 1e-9) * reach;
  return 1.0 - smoothstep(13.0, 30.0, bend);
}
float within(float open) { return 1.0 - smoothstep(0.02, 0.42, open); }
// A broad lamp, whose reflection on a smooth body is larger than a point.
float window_(vec3 seen, vec3 lamp) { return smoothstep(0.80, 0.93, dot(seen, lamp)); }`;

/**
 * Wet tissue: red light scatters the farthest, so shadows have warm edges; a thin film of liquid reflects lamp and
 * sky.
 */
export class Skin extends ShaderMaterial {
  constructor(isBody: boolean) {
    super({
      defines: isBody ? { BODY: "" } : {},
      side: DoubleSide,
      uniforms: {
        ...light,
        map: { value: null },
        mapped: { value: 0 },
        tone: { value: new Color(0x8e4538) },
        projected: { value: 1 },
        period: { value: 1 },
        /** For a body: whether its inner side is never visible, except for slivers at its outline. */
        closed: { value: 0 },
        /** For a body: the range of a lamp beside the eye, m. */
        reach: { value: 1 },
      },
      vertexShader: `
        #ifdef BODY
        attribute vec3 rest;
        attribute vec3 restNormal;
        attribute float inner;
        varying vec3 vRest;
        varying vec3 vRestNormal;
        varying float vInner;
        #endif
        attribute float open;
        attribute float burn;
        varying vec3 vAt;
        varying vec3 vNormal;
        varying vec2 vUv;
        varying float vOpen;
        varying float vBurn;
        void main() {
          vAt = position;
          vNormal = normal;
          vUv = uv;
          vOpen = open;
          vBurn = burn;
          #ifdef BODY
          vRest = rest;
          vRestNormal = restNormal;
          vInner = inner;
          #endif
          gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0);
        }`,
      fragmentShader: `
        uniform sampler2D map;
        uniform float mapped;
        uniform vec3 tone;
        uniform vec4 rings[${SHADOWS + 1}];
        uniform vec3 ink;
        uniform float reach;
        varying vec3 vAt;
        varying vec3 vNormal;
        varying vec2 vUv;
        varying float vOpen;
        varying float vBurn;
        ${isBody ? BODY : SHEET}
        ${SHADOW}
        void main() {
          vec3 eye = normalize(cameraPosition - vAt);
          vec3 n = normalize(vNormal);
          // Uses the triangle, not the interpolated normal: at the outline of a fold this faces away, and the fold
          // would be black.
          if (!gl_FrontFacing && isTurned()) n = -n;
          vec3 colour = mix(tone, image(), mapped);
          // Burnt tissue turns brown, then black, and is dry: it no longer shines.
          float dry = 1.0 - smoothstep(0.0, 0.5, vBurn);
          colour = mix(colour, mix(vec3(0.16, 0.055, 0.025), vec3(0.012, 0.010, 0.009), smoothstep(0.4, 1.0, vBurn)), smoothstep(0.0, 0.6, vBurn));
          float open = openness(dot(n, eye));
          float inside = within(open);
          float share = lit(vAt);
          float near = contact(vAt);
          vec3 wrap = vec3(0.28, 0.10, 0.07);
          vec3 diffuse = max((dot(n, lamp) + wrap) / (1.0 + wrap), 0.0);
          vec3 around = mix(vec3(0.17, 0.09, 0.08), vec3(0.30, 0.32, 0.36), 0.5 + 0.5 * n.z) * open * near;
          // A shadow in tissue is never black: light comes through from the side.
          vec3 key = diffuse * mix(vec3(0.26, 0.13, 0.12), vec3(1.0), share) * (1.0 - inside);
          // The lamp, and a weak light beside the eye. Where the lamp can't reach, a stronger light, which fades with
          // distance.
          float beside = 0.24 * max(dot(n, eye), 0.0) * near * open;
          float apart = length(cameraPosition - vAt) / reach;
          float scope = inside / (0.25 + 1.5 * apart * apart);
          beside += (0.15 + max(dot(n, eye), 0.0)) * near * scope;
          vec3 shown = colour * (around + beside + 1.0 * vec3(1.0, 0.965, 0.92) * key * mix(0.55, 1.0, open * near));
          // Bright tissue keeps its colour.
          shown = 1.0 - exp(-1.15 * shown);
          vec3 half_ = normalize(lamp + eye);
          float h = max(dot(n, half_), 0.0);
          float graze = 1.0 - max(dot(n, eye), 0.0);
          float mirror = 0.04 + 0.96 * graze * graze * graze * graze * graze;
          float sheen = h * h;
          sheen *= sheen;
          sheen *= sheen;
          sheen *= sheen;
          sheen *= sheen * sheen;
          float glint = 0.8 * smoothstep(0.9984, 0.9994, h) + 0.055 * sheen;
          vec3 seen = reflect(-eye, n);
          float sky = (0.30 * smoothstep(0.15, 0.9, seen.z) + 0.85 * window_(seen, lamp) * share * (1.0 - inside)) * (0.25 + 2.4 * mirror);
          float inner = max(dot(n, eye), 0.0);
          glint = glint * (1.0 - inside) + 0.35 * min(scope, 1.0) * smoothstep(0.985, 0.9985, inner);
          shown += dry * (glint * glints(n) * share + 0.16 * sky * open) * near * vec3(1.0, 0.98, 0.95);
          for (int i = 0; i <= ${SHADOWS}; i++) if (rings[i].w > 0.0) {
            float off = abs(length(vAt - rings[i].xyz) / rings[i].w - 1.0);
            shown = mix(shown, ink, (i < ${SHADOWS} ? 0.35 : 0.9) * (1.0 - smoothstep(0.03, 0.09, off)));
          }
          gl_FragColor = vec4(shown, 1.0);
          #include <colorspace_fragment>
        }`,
    });
  }

  setTexture(texture: Texture): void {
    (this.uniforms.map!.value as Texture | null)?.dispose();
    this.uniforms.map!.value = texture;
    this.uniforms.mapped!.value = 1;
  }

  /** Shows no texture until that of another tissue arrives. */
  dropTexture(): void {
    this.uniforms.mapped!.value = 0;
  }
}

/** Tissue between the lips of a wound, which little light reaches; and the lines along the lips, a little before what they lie on. */
export class WoundInside extends ShaderMaterial {
  constructor(colour: number, nearer: number) {
    super({
      side: DoubleSide,
      uniforms: { colour: { value: new Color(colour) }, nearer: { value: nearer } },
      vertexShader: `
        uniform float nearer;
        void main() {
          gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0);
          gl_Position.z -= nearer * gl_Position.w;
        }`,
      fragmentShader: `
        uniform vec3 colour;
        void main() {
          gl_FragColor = vec4(colour, 1.0);
          #include <colorspace_fragment>
        }`,
    });
  }
}

/**
 * The surface within the cuts of a solid: the tissue's colour, darker and redder, with grains of some tenths of a millimetre to some
 * millimetres, wet. Its facets are those of the cells.
 */
export class CutSurfaceMaterial extends ShaderMaterial {
  constructor() {
    super({
      side: DoubleSide,
      uniforms: { ...light, map: { value: null }, mapped: { value: 0 }, tone: { value: new Color() } },
      vertexShader: `
        attribute vec3 rest;
        varying vec3 vAt;
        varying vec3 vRest;
        void main() {
          vAt = position;
          vRest = rest;
          gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0);
        }`,
      fragmentShader: `
        uniform sampler2D map;
        uniform float mapped;
        uniform vec3 tone;
        varying vec3 vAt;
        varying vec3 vRest;
        ${SHADOW}
        float hash(vec3 at) { return fract(sin(dot(at, vec3(127.1, 311.7, 74.7))) * 43758.5453); }
        float grain(vec3 at) {
          vec3 cell = floor(at), part = fract(at);
          part = part * part * (3.0 - 2.0 * part);
          vec2 e = vec2(0.0, 1.0);
          vec4 low = vec4(hash(cell), hash(cell + e.yxx), hash(cell + e.xyx), hash(cell + e.yyx));
          vec4 high = vec4(hash(cell + e.xxy), hash(cell + e.yxy), hash(cell + e.xyy), hash(cell + e.yyy));
          vec4 along = mix(low, high, part.z);
          vec2 across = mix(along.xy, along.zw, part.y);
          return mix(across.x, across.y, part.x);
        }
        void main() {
          vec3 eye = normalize(cameraPosition - vAt);
          vec3 n = normalize(cross(dFdx(vAt), dFdy(vAt)));
          if (dot(n, eye) < 0.0) n = -n;
          // The mean colour of the image.
          vec3 colour = mix(tone, texture2D(map, vec2(0.5), 16.0).rgb, mapped) * vec3(0.95, 0.62, 0.58);
          float grains = 0.5 * grain(vRest * 450.0) + 0.3 * grain(vRest * 1100.0) + 0.2 * grain(vRest * 2600.0);
          colour *= 0.72 + 0.56 * grains;
          float share = lit(vAt);
          float near = contact(vAt);
          vec3 wrap = vec3(0.28, 0.10, 0.07);
          vec3 diffuse = max((dot(n, lamp) + wrap) / (1.0 + wrap), 0.0) * mix(vec3(0.26, 0.13, 0.12), vec3(1.0), share);
          vec3 shown = colour * near * (0.16 + 0.45 * max(dot(n, eye), 0.0) + 0.7 * diffuse);
          shown = 1.0 - exp(-1.15 * shown);
          float h = max(dot(n, normalize(lamp + eye)), 0.0);
          shown += 0.10 * near * share * pow(h, 40.0) * (0.4 + grains);
          gl_FragColor = vec4(shown, 1.0);
          #include <colorspace_fragment>
        }`,
    });
  }

  /** Takes on the colour of a skin, also when that changes. */
  follow(skin: Skin): void {
    for (const name of ["map", "mapped", "tone"]) this.uniforms[name] = skin.uniforms[name]!;
    this.uniformsNeedUpdate = true;
  }
}

/** The table that the tissue lies on. It fades into the background, and the tissue's shadow lies on it. */
export class Table extends ShaderMaterial {
  constructor(isBody: boolean) {
    super({
      defines: isBody ? { BODY: "" } : {},
      uniforms: {
        ...light,
        /** For a body: how dark the table is beneath it, up to `half_` on each side of the middle. */
        dark: { value: null },
        colour: { value: new Color() },
        background: { value: new Color() },
        middle: { value: new Vector2() },
        half_: { value: new Vector2(1, 1) },
        height: { value: 1 },
      },
      vertexShader: `
        varying vec3 vAt;
        void main() {
          vAt = position;
          gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0);
        }`,
      fragmentShader: `
        uniform vec3 colour;
        uniform vec3 background;
        uniform vec2 middle;
        uniform vec2 half_;
        uniform float height;
        varying vec3 vAt;
        ${SHADOW}
        #ifdef BODY
        uniform sampler2D dark;
        #endif
        float away(vec2 at) {
          vec2 q = abs(at - middle) - half_;
          return length(max(q, 0.0)) + min(max(q.x, q.y), 0.0);
        }
        void main() {
          #ifdef BODY
          float near = texture2D(dark, 0.5 + 0.5 * (vAt.xy - middle) / half_).r;
          float fallen = texture2D(dark, 0.5 + 0.5 * (vAt.xy + 0.3 * height * lamp.xy - middle) / half_).g;
          #else
          float near = exp(-max(away(vAt.xy), 0.0) / (0.30 * height));
          float fallen = 1.0 - smoothstep(-0.35 * height, 0.45 * height, away(vAt.xy + lamp.xy / lamp.z * 0.62 * height));
          #endif
          vec3 shown = colour * (1.0 - 0.55 * near) * (1.0 - 0.38 * fallen) * mix(0.6, 1.0, lit(vAt));
          float size = max(half_.x, half_.y);
          shown = mix(shown, background, smoothstep(0.5 * size, 2.6 * size, length(vAt.xy - middle) - size));
          gl_FragColor = vec4(shown, 1.0);
          #include <colorspace_fragment>
        }`,
    });
  }
}

/** Polished steel in a bright room. */
export class Steel extends ShaderMaterial {
  constructor(colour: number) {
    super({
      uniforms: { ...light, colour: { value: new Color(colour) } },
      vertexShader: `
        varying vec3 vAt;
        varying vec3 vNormal;
        void main() {
          vec4 at = modelMatrix * vec4(position, 1.0);
          vAt = at.xyz;
          vNormal = mat3(modelMatrix) * normal;
          gl_Position = projectionMatrix * viewMatrix * at;
        }`,
      fragmentShader: `
        uniform vec3 colour;
        uniform vec3 lamp;
        varying vec3 vAt;
        varying vec3 vNormal;
        void main() {
          vec3 eye = normalize(cameraPosition - vAt);
          vec3 n = normalize(vNormal);
          vec3 seen = reflect(-eye, n);
          float room = mix(0.10, 0.75, smoothstep(-0.4, 0.7, seen.z)) + 0.35 * smoothstep(0.55, 0.8, dot(seen, lamp));
          float h = max(dot(n, normalize(lamp + eye)), 0.0);
          vec3 shown = colour * (room + 0.35 * max(dot(n, lamp), 0.0)) + 0.8 * smoothstep(0.985, 0.996, h);
          gl_FragColor = vec4(shown, 1.0);
          #include <colorspace_fragment>
        }`,
    });
  }
}
