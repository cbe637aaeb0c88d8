// The base class of haptic devices. Palpate's tests do not build it, because they have no Unity.
using UnityEngine;

namespace Palpate
{
    /// <summary>A haptic device that libpalpate calls a thousand times a second, on its own thread. Derive from it,
    /// and call your device's SDK in Read and Write; these must not use any Unity object.</summary>
    public abstract class PalpateDevice : MonoBehaviour, IDevice
    {
        public PalpateTissue tissue;
        Bridge bridge;

        public abstract Limits Limits { get; }
        public abstract Reading Read();
        public abstract void Write(Vector force);

        /// <summary>State of the loop.</summary>
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
