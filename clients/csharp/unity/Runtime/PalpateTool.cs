// A tool at 1 kHz. Not built by Palpate's tests: they have no Unity.
using System.Diagnostics;
using System.Threading;
using UnityEngine;

namespace Palpate
{
    /// <summary>Leads a tool where this object is, on a thread of its own at 1 kHz, and tells the force. The object follows the
    /// mouse over the tissue.</summary>
    public sealed class PalpateTool : MonoBehaviour
    {
        public PalpateTissue tissue;
        [Tooltip("How far the tool goes in while the left button is down, m.")] public float press = 0.004f;
        [Tooltip("How far it is off the surface else, m.")] public float hover = 0.002f;

        /// <summary>The force on the tool, N, in the coordinates of the tissue.</summary>
        public Vector3 Force { get; private set; }

        // What the two threads exchange: whole values, the newest counts.
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
            // Along the normal of the surface at rest, of a sheet or of a mesh, where the mouse is over it.
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

        // In place of `at`, a haptic device would be read here, and told the force.
        void Run()
        {
            var clock = Stopwatch.StartNew();
            var at = new Reading();
            for (long tick = 1; !isOver; tick++)
            {
                Reading to;
                lock (exchange) to = wanted;
                // A mouse jumps sixty times a second; a hand does not.
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
