// A tissue and a tool, made in code. The scene Touch has this component on an object, a camera and a light: open it, and press Play.
// Palpate's tests do not build it, because they have no Unity.
using UnityEngine;

namespace Palpate.Samples
{
    /// <summary>Creates a tissue and a tool in front of the main camera. Hold the left button to press, E to enable
    /// forces.</summary>
    public sealed class TouchSample : MonoBehaviour
    {
        public string url = "http://127.0.0.1:7117";
        public string scene = "liver";
        public Material material;

        PalpateTool tool;

        void Awake()
        {
            // Inactive until the components have their values: PalpateTissue connects as soon as it wakes.
            var tissueObject = new GameObject("Tissue");
            tissueObject.SetActive(false);
            tissueObject.AddComponent<MeshFilter>();
            tissueObject.AddComponent<MeshRenderer>().sharedMaterial = material;
            var tissue = tissueObject.AddComponent<PalpateTissue>();
            tissue.url = url;
            tissue.scene = scene;
            tissueObject.SetActive(true);

            var toolObject = new GameObject("Tool");
            toolObject.SetActive(false);
            tool = toolObject.AddComponent<PalpateTool>();
            tool.tissue = tissue;
            toolObject.SetActive(true);

            // Half a tissue's width above its middle, and a little to the side.
            var bounds = tissueObject.GetComponent<MeshFilter>().sharedMesh.bounds;
            var camera = Camera.main.transform;
            camera.position = bounds.center + bounds.size.magnitude * new Vector3(0.0f, 0.9f, -0.7f);
            camera.LookAt(bounds.center);
            Camera.main.nearClipPlane = 0.001f;
        }

        void OnGUI()
        {
            GUI.Label(new Rect(10, 10, 400, 30), "Force on the tool: " + tool.Force.magnitude.ToString("F2") + " N");
        }
    }
}
