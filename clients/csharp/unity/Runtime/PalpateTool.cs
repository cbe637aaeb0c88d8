// A tool at 1 kHz. Palpate's tests do not build it, because they have no Unity.
using System.Diagnostics;
using System.Threading;
using UnityEngine;

namespace Palpate
{
    /// <summary>Moves a tool to the position of this object, on its own thread at 1 kHz, and provides the force. The
    /// object follows the mouse over the tissue.</summary>
    public sealed class PalpateTool : MonoBehaviour
    {
        public PalpateTissue tissue;
        [Tooltip("How far the tool goes in while the left button is down, m.")] public float press = 0.004f;
        [Tooltip("How far it is off the surface else, m.")] public float hover = 0.002f;

        /// <summary>The force on the tool, N, in the coordinates of the tissue.</summary>
        public Vector3 Force { get; private set; }

        // Data that the two threads exchange, always as complete values; only the newest counts.
        readonly object exchange = new object();
        Reading wanted;
        Felt felt;
        volatile bool isOver;
        Touch touch;
        Thread loop;

        void Start()
        {
            var options = TouchOptions.Default;
            options.Axes = Axes.Unity;
            options.InTissueFrame = true;
            options.Limits = Limits.Of("omega3");
            options.Limits.WorkspaceRadius = 1.0;
            touch = tissue.Session.Touch(options);
            loop = new Thread(Run) { IsBackground = true, Priority = System.Threading.ThreadPriority.Highest };
            loop.Start();
        }

        void Update()
        {
            var ray = Camera.main.ScreenPointToRay(Input.mousePosition);
            // Along the normal of the surface at rest, of a sheet or of a mesh, where the mouse points at it.
            RaycastHit hit;
            if (!tissue.Rest.Raycast(ray, out hit, Camera.main.farClipPlane)) return;
            var normal = tissue.transform.InverseTransformDirection(hit.normal);
            var depth = Input.GetMouseButton(0) ? press : -hover;
            var place = tissue.transform.InverseTransformPoint(hit.point) - depth * normal;
            transform.position = tissue.transform.TransformPoint(place);
            lock (exchange)
            {
                wanted = new Reading(new Vector(place.x, place.y, place.z), Input.GetKey(KeyCode.E));
                Force = new Vector3((float)felt.Force.X, (float)felt.Force.Y, (float)felt.Force.Z);
            }
        }

        // With a haptic device, read its position here instead of `at`, and send it the force.
        void Run()
        {
            var clock = Stopwatch.StartNew();
            var at = new Reading();
            for (long tick = 1; !isOver; tick++)
            {
                Reading to;
                lock (exchange) to = wanted;
                // The mouse moves in jumps sixty times a second; a hand does not. So its movement is smoothed.
                const double share = 0.02;
                at.Position.X += share * (to.Position.X - at.Position.X);
                at.Position.Y += share * (to.Position.Y - at.Position.Y);
                at.Position.Z += share * (to.Position.Z - at.Position.Z);
                at.Enable = to.Enable;
                var now = touch.Tick(at, clock.Elapsed.TotalSeconds);
                lock (exchange) felt = now;
                while (clock.Elapsed.TotalMilliseconds < tick) Thread.Sleep(0);
            }
        }

        void OnDestroy()
        {
            isOver = true;
            if (loop != null) loop.Join();
            if (touch != null) touch.Dispose();
        }
    }
}
