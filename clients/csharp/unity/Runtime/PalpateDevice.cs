// The base of haptic devices. Not built by Palpate's tests: they have no Unity.
using UnityEngine;

namespace Palpate
{
    /// <summary>A haptic device that libpalpate calls a thousand times a second, on a thread of its own. Derive from it, with your maker's
    /// calls in Read and Write; these must touch nothing of Unity.</summary>
    public abstract class PalpateDevice : MonoBehaviour, IDevice
    {
        public PalpateTissue tissue;
        Bridge bridge;

        public abstract Limits Limits { get; }
        public abstract Reading Read();
        public abstract void Write(Vector force);

        /// <summary>How the loop stands.</summary>
        public BridgeState State { get { return bridge == null ? default(BridgeState) : bridge.Look(); } }

        protected virtual void Start()
        {
            var options = TouchOptions.Default;
            options.Axes = Axes.Unity;
            bridge = tissue.Session.Bridge(this, options);
            if (bridge.Look().Priority == Priority.Refused) Debug.LogWarning("the haptic loop has no real-time priority");
        }

        protected virtual void OnDestroy() { if (bridge != null) bridge.Dispose(); }
    }
}
