// The tissue of a session as a Mesh. Palpate's tests do not build it, because they have no Unity.
using System.Collections.Generic;
using UnityEngine;

namespace Palpate
{
    /// <summary>Creates a session, and shows its surface as the mesh of this object, in its local
    /// coordinates.</summary>
    [RequireComponent(typeof(MeshFilter))]
    public sealed class PalpateTissue : MonoBehaviour
    {
        public string url = "http://127.0.0.1:7117";
        [Tooltip("A scene of the server, if there is no text of one of your own.")] public string scene = "liver";
        [Tooltip("The text of a scene (TOML) of your own. Its [mesh] says file = \"mesh.obj\" and unit = \"m\".")] public
        TextAsset sceneText; [Tooltip("With that text: the mesh to touch, which has to be readable. It is sent to the server.")]
        public Mesh ownMesh; [Range(0, 10)] public int refinement = 1;

        /// <summary>The session; null while there is none.</summary>
        public Session Session { get; private set; }

        /// <summary>The surface at rest, for ray casts.</summary>
        public MeshCollider Rest { get; private set; }

        Server server;
        Surface surface;
        Mesh mesh;
        Vector3[] positions, normals;

        void Awake()
        {
            server = new Server(url);
            Session = Create();
            surface = Session.Surface(Axes.Unity, refinement);
            int vertices = surface.Positions.Length / 3;
            positions = new Vector3[vertices];
            normals = new Vector3[vertices];
            mesh = new Mesh { name = scene, indexFormat = UnityEngine.Rendering.IndexFormat.UInt32 };
            mesh.MarkDynamic();
            Show(surface.Read());
            mesh.triangles = surface.Indices;
            if (surface.Uv != null)
            {
                var uv = new List<Vector2>(vertices);
                for (int k = 0; k < vertices; k++) uv.Add(new Vector2(surface.Uv[2 * k], surface.Uv[2 * k + 1]));
                mesh.SetUVs(0, uv);
            }
            GetComponent<MeshFilter>().sharedMesh = mesh;
            // The tissue at rest: rays hit this, whatever the tool has done to the tissue.
            var atRest = new Mesh { name = scene + " at rest", indexFormat = UnityEngine.Rendering.IndexFormat.UInt32 };
            atRest.SetVertices(positions);
            atRest.triangles = surface.Indices;
            Rest = gameObject.AddComponent<MeshCollider>();
            Rest.sharedMesh = atRest;
        }

        Session Create()
        {
            if (sceneText == null) return server.Create(scene);
            if (ownMesh == null) return server.CreateFromText(sceneText.text);
            var corners = ownMesh.vertices;
            var places = new float[3 * corners.Length];
            for (int k = 0; k < corners.Length; k++)
                for (int axis = 0; axis < 3; axis++) places[3 * k + axis] = corners[k][axis];
            return server.CreateFromMesh(sceneText.text, "mesh.obj", Server.Obj(places, ownMesh.triangles, Axes.Unity));
        }

        // Never waits for the server.
        void Update()
        {
            var dirty = surface.Read();
            if (dirty.Count > 0) Show(dirty);
        }

        void Show(Dirty dirty)
        {
            for (int k = dirty.First; k < dirty.First + dirty.Count; k++)
            {
                positions[k] = new Vector3(surface.Positions[3 * k], surface.Positions[3 * k + 1], surface.Positions[3 * k + 2]);
                normals[k] = new Vector3(surface.Normals[3 * k], surface.Normals[3 * k + 1], surface.Normals[3 * k + 2]);
            }
            mesh.SetVertices(positions);
            mesh.SetNormals(normals);
            mesh.RecalculateBounds();
        }

        void OnDestroy()
        {
            if (surface != null) surface.Dispose();
            if (Session != null) { Session.Delete(); Session.Dispose(); }
            if (server != null) server.Dispose();
        }
    }
}
