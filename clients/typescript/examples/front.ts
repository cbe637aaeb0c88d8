// A complete front end: any scene (front.html?scene=gallbladder), drawn with three.js, touched with the mouse.

import { fetchMesh, Field, Frames, Server, Tool, vec, watchSamples } from "palpate";
import { BufferAttribute, BufferGeometry, DirectionalLight, DoubleSide, HemisphereLight, Mesh, MeshStandardMaterial, PerspectiveCamera, Raycaster, Scene, Vector2, Vector3, WebGLRenderer } from "three";

const told = document.getElementById("told")!;
const server = new Server(location.origin);
const sceneName = new URLSearchParams(location.search).get("scene") ?? "liver";
const { session } = await server.sessions.createSession({ source: { case: "sceneName", value: sceneName } });
const { sessionId } = session!;

// The surface: positions at rest and triangles are fetched once; displacements come in frames.
const mesh = await fetchMesh(server, sessionId);
const field = new Field(...mesh.places);
const geometry = new BufferGeometry();
const positions = new BufferAttribute(mesh.restM.slice(), 3);
geometry.setAttribute("position", positions).setIndex(new BufferAttribute(mesh.triangles, 1));
geometry.computeVertexNormals();
geometry.computeBoundingSphere();
const tissue = new Mesh(geometry, new MeshStandardMaterial({ color: 0xb5483c, roughness: 0.35, side: DoubleSide }));

const { center, radius } = geometry.boundingSphere!;
const camera = new PerspectiveCamera(40, innerWidth / innerHeight, radius / 100, 20 * radius);
camera.up.set(0, 0, 1);
camera.position.copy(center).add(new Vector3(0, -2, 2).multiplyScalar(radius));
camera.lookAt(center);
const light = new DirectionalLight(0xffffff, 2);
light.position.set(-1, -1, 2);
const picture = new Scene().add(tissue, light, new HemisphereLight(0xffffff, 0x604040, 1));
const renderer = new WebGLRenderer({ antialias: true });
renderer.setSize(innerWidth, innerHeight);
document.body.append(renderer.domElement);

const frames = new Frames(server);
frames.onFrame = () => {
  for (let i = 0; i < mesh.restM.length; i++) positions.array[i] = mesh.restM[i]! + field.displacementM[i]!;
  positions.needsUpdate = true;
  geometry.computeVertexNormals();
};
frames.run(sessionId, 0, field, new AbortController().signal);
renderer.setAnimationLoop(() => renderer.render(picture, camera));

// The mouse moves a tip a few millimetres below the surface.
const tool = new Tool(server, sessionId, "front");
const radiusM = Math.max(0.02 * radius, 2 * mesh.edgeM);
renderer.domElement.onpointermove = renderer.domElement.onpointerdown = ({ clientX, clientY, buttons }) => {
  const at = new Vector2((2 * clientX) / innerWidth - 1, 1 - (2 * clientY) / innerHeight);
  const hit = (() => { const ray = new Raycaster(); ray.setFromCamera(at, camera); return ray.intersectObject(tissue)[0]; })();
  if (!buttons || !hit?.normal) return tool.rest();
  const deep = hit.point.clone().addScaledVector(hit.normal, -0.6 * radiusM);
  void tool.lead({ positionM: [deep.x, deep.y, deep.z], radiusM });
};
renderer.domElement.onpointerup = () => tool.rest();
void watchSamples(server, sessionId, 10, ({ tools }) => {
  told.textContent = `${sceneName}: ${Math.hypot(...vec(tools[0]?.forceOnToolN)).toFixed(2)} N`;
}, new AbortController().signal);
