// Stand-ins for the part of Unity's interface that the package uses, so that mcs can compile it. They do nothing.
using System;
using System.Collections.Generic;

namespace UnityEngine.Rendering { public enum IndexFormat { UInt16, UInt32 } }

namespace UnityEngine
{
    public class Object { public string name; }
    public class Component : Object
    {
        public GameObject gameObject { get { return null; } }
        public Transform transform { get { return null; } }
        public T GetComponent<T>() { return default(T); }
    }
    public class Behaviour : Component { }
    public class MonoBehaviour : Behaviour { }
    public sealed class GameObject : Object
    {
        public GameObject(string name) { }
        public T AddComponent<T>() where T : Component { return default(T); }
        public T GetComponent<T>() { return default(T); }
        public void SetActive(bool value) { }
    }
    public class Transform : Component
    {
        public Vector3 position { get; set; }
        public void LookAt(Vector3 point) { }
        public Vector3 TransformPoint(Vector3 point) { return point; }
        public Vector3 InverseTransformPoint(Vector3 point) { return point; }
        public Vector3 InverseTransformDirection(Vector3 direction) { return direction; }
    }
    public struct Vector2 { public Vector2(float x, float y) { } }
    public struct Vector3
    {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
        public float magnitude { get { return 0; } }
        public float this[int axis] { get { return 0; } set { } }
        public static Vector3 operator +(Vector3 a, Vector3 b) { return a; }
        public static Vector3 operator -(Vector3 a, Vector3 b) { return a; }
        public static Vector3 operator *(float a, Vector3 b) { return b; }
    }
    public struct Bounds { public Vector3 center, size; }
    public struct Ray { }
    public struct RaycastHit { public Vector3 point, normal; }
    public struct Rect { public Rect(float x, float y, float width, float height) { } }
    public sealed class Mesh : Object
    {
        public Rendering.IndexFormat indexFormat;
        public int[] triangles;
        public Vector3[] vertices;
        public Bounds bounds;
        public void MarkDynamic() { }
        public void SetVertices(Vector3[] vertices) { }
        public void SetNormals(Vector3[] normals) { }
        public void SetUVs(int channel, List<Vector2> uv) { }
        public void RecalculateBounds() { }
    }
    public sealed class MeshFilter : Component { public Mesh sharedMesh; }
    public class Material : Object { }
    public class Renderer : Component { public Material sharedMaterial; }
    public sealed class MeshRenderer : Renderer { }
    public class Collider : Component
    {
        public bool Raycast(Ray ray, out RaycastHit hit, float distance) { hit = default(RaycastHit); return false; }
    }
    public sealed class MeshCollider : Collider { public Mesh sharedMesh; }
    public class TextAsset : Object { public string text; }
    public sealed class Camera : Behaviour
    {
        public static Camera main;
        public float nearClipPlane, farClipPlane;
        public Ray ScreenPointToRay(Vector3 point) { return default(Ray); }
    }
    public enum KeyCode { E }
    public static class Input
    {
        public static Vector3 mousePosition;
        public static bool GetMouseButton(int button) { return false; }
        public static bool GetKey(KeyCode key) { return false; }
    }
    public static class Debug { public static void LogWarning(object message) { } }
    public static class GUI { public static void Label(Rect place, string text) { } }
    public sealed class TooltipAttribute : Attribute { public TooltipAttribute(string text) { } }
    public sealed class RangeAttribute : Attribute { public RangeAttribute(float least, float most) { } }
    public sealed class RequireComponent : Attribute { public RequireComponent(Type type) { } }
}
