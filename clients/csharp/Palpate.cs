// Palpate for C#: libpalpate by P/Invoke, and a small interface over it. It is a single file: copy it into your
// project, and put libpalpate.so (Windows: palpate.dll) where your program finds native libraries. For C# 7, .NET
// Standard 2.0, Mono, Unity. The rules of palpate.h apply: which thread may call what, and which calls wait.
using System;
using System.Globalization;
using System.Runtime.InteropServices;
using System.Text;

namespace Palpate
{
    /// <summary>Three components, in the axes that were requested.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Vector
    {
        public double X, Y, Z;
        public Vector(double x, double y, double z) { X = x; Y = y; Z = z; }
        public double Length { get { return Math.Sqrt(X * X + Y * Y + Z * Z); } }
    }

    /// <summary>An orientation of length 1, in the axes that were requested; see palpate_quaternion.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Orientation
    {
        public double W, X, Y, Z;
        public Orientation(double w, double x, double y, double z) { W = w; X = x; Y = y; Z = z; }
        /// <summary>Not turned: the instrument points along Palpate's x.</summary>
        public static Orientation Identity { get { return new Orientation(1.0, 0.0, 0.0, 0.0); } }
    }

    /// <summary>Axes and unit of positions, normals and forces; see palpate_axes.</summary>
    public enum Axes : uint { Own = 0, Unity = 1, Unreal = 2 }

    /// <summary>How a tip presses: with an even pressure, or rigid, which solids alone take; or a blade, which cuts; see
    /// palpate_tip_shape.</summary>
    public enum TipShape : uint { Disc = 0, RigidDisc = 1, Sphere = 2, Blade = 3 }

    /// <summary>Whether forces are rendered; see palpate_state.</summary>
    public enum State : uint { Waiting = 0, Disabled = 1, Enabled = 2, Paused = 3, Fault = 4 }

    /// <summary>Scheduling priority of a loop; see palpate_priority.</summary>
    public enum Priority : uint { Usual = 0, RealTime = 1, Refused = 2 }

    /// <summary>Why a call failed; see palpate_result.</summary>
    public enum Code { Ok = 0, Argument = 1, Connection = 2, Refused = 3, Device = 4, Buffer = 5, Busy = 6, Internal = 7 }

    /// <summary>The bounding box of a tissue at rest, in Palpate's own axes, m.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Extent { public Vector Least, Most, Middle, Top; }

    /// <summary>What a device reports.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Reading
    {
        public Vector Position;
        uint enable;
        public Reading(Vector position, bool enabled) { Position = position; enable = enabled ? 1u : 0u; }
        public bool Enable { get { return enable != 0; } set { enable = value ? 1u : 0u; } }
    }

    /// <summary>Result of a tick.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Felt
    {
        public Vector Force;
        uint state, isOver;
        /// <summary>Age of the newest data about the tissue, s; negative before the first.</summary>
        public double Age;
        public State State { get { return (State)state; } }
        public bool IsOver { get { return isOver != 0; } }
    }

    /// <summary>What a device of six axes reports; see palpate_instrument_reading.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct InstrumentReading
    {
        public Vector Position;
        public Orientation Orientation;
        /// <summary>Angle between the jaws, rad.</summary>
        public double JawAngle;
        uint enable, unused;
        public InstrumentReading(Vector position, Orientation orientation, double jawAngle, bool enabled)
        {
            Position = position;
            Orientation = orientation;
            JawAngle = jawAngle;
            enable = enabled ? 1u : 0u;
            unused = 0;
        }
        public bool Enable { get { return enable != 0; } set { enable = value ? 1u : 0u; } }
    }

    /// <summary>Result of a tick with an instrument; see palpate_instrument_felt.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct InstrumentFelt
    {
        public Vector Force, Torque;
        /// <summary>Orientation of the instrument, whose shaft passes through the port.</summary>
        public Orientation Orientation;
        uint state, isOver;
        /// <summary>Age of the newest data about the tissue, s; negative before the first.</summary>
        public double Age;
        public State State { get { return (State)state; } }
        public bool IsOver { get { return isOver != 0; } }
    }

    /// <summary>Limits of a haptic device; see palpate_limits.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Limits
    {
        public double MaxForce, ContinuousForce, MaxStiffness, MaxDamping, WorkspaceRadius;
        public static Limits Of(string device)
        {
            Limits limits;
            Native.Check(Native.palpate_limits_of(Native.Utf8(device), out limits));
            return limits;
        }
    }

    /// <summary>Network traffic; see palpate_traffic.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Traffic { public ulong Connections, Failed, Samples, Positions; uint connected, unused; public bool IsConnected { get { return connected != 0; } } }

    /// <summary>State of a loop; see palpate_bridge_state.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct BridgeState
    {
        public ulong Ticks;
        public Vector Position, Force;
        uint state, priority, isOver, unused;
        public State State { get { return (State)state; } }
        public Priority Priority { get { return (Priority)priority; } }
        public bool IsOver { get { return isOver != 0; } }
    }

    /// <summary>State of an instrument; see palpate_instrument_state.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct InstrumentState
    {
        public ulong Ticks;
        public Vector Position;
        public Orientation Orientation;
        /// <summary>Angle between the jaws, rad.</summary>
        public double JawAngle;
        public Vector Force, Torque;
        uint state, priority, isOver, unused;
        public State State { get { return (State)state; } }
        public Priority Priority { get { return (Priority)priority; } }
        public bool IsOver { get { return isOver != 0; } }
    }

    /// <summary>Statistics of a loop; see palpate_bridge_report.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Report
    {
        public ulong Ticks, LateTicks, MissedTicks, Connections, Samples, Positions;
        uint priority, result;
        public Priority Priority { get { return (Priority)priority; } }
        /// <summary>Why the loop ended: Ok if you ended it.</summary>
        public Code Result { get { return (Code)result; } }
    }

    /// <summary>State of a session; see palpate_session_status.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Status
    {
        public ulong Step;
        public double Time;
        public uint TopologyVersion, Severed, Pieces;
        uint exhausted;
        /// <summary>Whether a solid has no room for further cuts, so that blades only push.</summary>
        public bool CutsExhausted { get { return exhausted != 0; } }
    }

    /// <summary>A thread or clip; see palpate_tie.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Tie
    {
        public uint Number;
        uint clip;
        public double Length, Path, Tension;
        uint broken, unused;
        public bool IsClip { get { return clip != 0; } }
        public bool IsBroken { get { return broken != 0; } }
    }

    /// <summary>Options of a thread or clip; see palpate_tie_options. Session sets the bites and the length.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct TieOptions
    {
        UIntPtr size;
        public uint Tool;
        public Axes Axes;
        internal IntPtr Bites;
        internal UIntPtr BiteCount;
        public double BiteRadius;
        internal double Length;
        public double Friction, Strength;
        public static TieOptions Default
        {
            get
            {
                TieOptions options;
                Native.Check(Native.palpate_tie_options_init(out options, (UIntPtr)Marshal.SizeOf(typeof(TieOptions))));
                return options;
            }
        }
    }

    /// <summary>A change of the tissue. Values that are NaN are left unchanged.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Change
    {
        public double Stiffness, Damping, AnchorStiffness, VolumeStiffness;
        public static Change None { get { double n = double.NaN; return new Change { Stiffness = n, Damping = n, AnchorStiffness = n, VolumeStiffness = n }; } }
    }

    /// <summary>Which part of a surface was written; see palpate_dirty.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct Dirty
    {
        UIntPtr first, count;
        public ulong Frames, Step;
        public double SimulationTime;
        public int First { get { return (int)first; } }
        public int Count { get { return (int)count; } }
    }

    /// <summary>Options for touching; see palpate_touch_options.</summary>
    [StructLayout(LayoutKind.Sequential)]
    public struct TouchOptions
    {
        UIntPtr size;
        public uint Tool;
        public Axes Axes;
        uint inTissueFrame, grasps;
        public double TipRadius, Friction;
        public Limits Limits;
        public double Deadband, UpDeadband;
        uint datagrams, realTime;
        IntPtr holder, warn, warnUser;
        /// <summary>Which tissues to keep a local copy of: 0 none, 1 meshes, 2 any; see
        /// palpate_touch_options.</summary>
        public uint Prediction;
        /// <summary>How the tip presses.</summary>
        public TipShape TipShape;
        /// <summary>Length of an instrument's jaws and of its shaft, m; 0: none.</summary>
        public double Jaws, Shaft;
        uint hasPort;
        /// <summary>The place through which the shaft slides, in the tissue's frame, if HasPort.</summary>
        public Vector Port;
        /// <summary>Distance from the instrument's tip to its handle, m.</summary>
        public double Handle;
        /// <summary>Largest torque of the device, N·m; 0: it renders none.</summary>
        public double MaxTorque;
        internal IntPtr Hand;
        /// <summary>The edge of a blade from its tip to its heel; see palpate_touch_options.</summary>
        public Vector Edge;
        /// <summary>Time of contact after which the tip severs by heat, s; 0: it does not burn.</summary>
        public double Burn;
        public bool HasPort { get { return hasPort != 0; } set { hasPort = value ? 1u : 0u; } }
        /// <summary>How many tools a loop with these options moves: one for each tip of an instrument.</summary>
        public uint ToolCount
        {
            get { uint count; Native.Check(Native.palpate_tool_count(ref this, out count)); return count; }
        }
        public bool InTissueFrame { get { return inTissueFrame != 0; } set { inTissueFrame = value ? 1u : 0u; } }
        public bool Grasps { get { return grasps != 0; } set { grasps = value ? 1u : 0u; } }
        public bool Datagrams { get { return datagrams != 0; } set { datagrams = value ? 1u : 0u; } }
        public bool RealTime { get { return realTime != 0; } set { realTime = value ? 1u : 0u; } }
        public static TouchOptions Default
        {
            get
            {
                TouchOptions options;
                Native.Check(Native.palpate_touch_options_init(out options, (UIntPtr)Marshal.SizeOf(typeof(TouchOptions))));
                return options;
            }
        }
    }

    [StructLayout(LayoutKind.Sequential)]
    struct SurfaceOptions { public UIntPtr Size; public Axes Axes; public uint Refinement; public double Rate; }

    [StructLayout(LayoutKind.Sequential)]
    struct SurfaceSize { public UIntPtr Vertices, Indices; public uint HasUv; }

    [StructLayout(LayoutKind.Sequential)]
    struct Buffers { public IntPtr Positions; public UIntPtr PositionsStride; public IntPtr Normals; public UIntPtr NormalsStride, Vertices; public uint Everything; }

    [StructLayout(LayoutKind.Sequential)]
    struct ConnectOptions { public UIntPtr Size; public IntPtr Token, Ca, TlsName, Certificate, Key; public double Timeout; }

    [StructLayout(LayoutKind.Sequential)]
    struct DeviceCalls { public IntPtr User, Descriptor, Read, Write; }

    /// <summary>An error that the library reported.</summary>
    public class PalpateException : Exception
    {
        public Code Code { get; private set; }
        public PalpateException(Code code, string words) : base(words) { Code = code; }
    }

    [UnmanagedFunctionPointer(CallingConvention.Cdecl)] delegate int Descriptor(IntPtr user, out Limits limits);
    [UnmanagedFunctionPointer(CallingConvention.Cdecl)] delegate int Read(IntPtr user, out Reading reading);
    [UnmanagedFunctionPointer(CallingConvention.Cdecl)] delegate int Write(IntPtr user, ref Vector force);
    [UnmanagedFunctionPointer(CallingConvention.Cdecl)] delegate int ReadInstrument(IntPtr user, ref InstrumentReading reading);
    [UnmanagedFunctionPointer(CallingConvention.Cdecl)] delegate int WriteInstrument(IntPtr user, ref Vector force, ref Vector torque);
    delegate Code LayTie(IntPtr session, uint number, ref TieOptions options);
    delegate Code WriteText(byte[] text, UIntPtr capacity, out UIntPtr needed);

    static class Native
    {
        const string Library = "palpate";
        const CallingConvention C = CallingConvention.Cdecl;
        [DllImport(Library, CallingConvention = C)] internal static extern IntPtr palpate_version();
        [DllImport(Library, CallingConvention = C)] internal static extern IntPtr palpate_last_error();
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_connect_options_init(out ConnectOptions options, UIntPtr size);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_touch_options_init(out TouchOptions options, UIntPtr size);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_surface_options_init(out SurfaceOptions options, UIntPtr size);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_limits_of(byte[] name, out Limits limits);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_connect(byte[] url, ref ConnectOptions options, out IntPtr server);
        [DllImport(Library, CallingConvention = C)] internal static extern void palpate_server_free(IntPtr server);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_scenes(IntPtr server, byte[] names, UIntPtr capacity, out UIntPtr needed);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_create(IntPtr server, byte[] scene, out IntPtr session);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_create_from_text(IntPtr server, byte[] scene, out IntPtr session);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_create_from_file(IntPtr server, byte[] path, out IntPtr session);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_create_from_mesh(IntPtr server, byte[] scene, byte[] name, byte[] bytes, UIntPtr count, out IntPtr session);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_join(IntPtr server, byte[] id, out IntPtr session);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_id(IntPtr session, byte[] id, UIntPtr capacity, out UIntPtr needed);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_extent(IntPtr session, out Extent extent);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_change(IntPtr session, ref Change change);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_delete(IntPtr session);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_status_of(IntPtr session, out Status status);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_severed_anchors(IntPtr session, out uint count);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_tie_options_init(out TieOptions options, UIntPtr size);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_thread(IntPtr session, uint number, ref TieOptions options);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_clip(IntPtr session, uint number, ref TieOptions options);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_untie(IntPtr session, uint tool, uint number);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_release(IntPtr session, uint tool);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_session_ties(IntPtr session, [Out] Tie[] ties, UIntPtr capacity, out UIntPtr count);
        [DllImport(Library, CallingConvention = C)] internal static extern void palpate_session_free(IntPtr session);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_touch_begin(IntPtr session, ref TouchOptions options, out IntPtr touch);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_touch_begin_offline(ref TouchOptions options, Vector middle, out IntPtr touch);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_touch_arrive(IntPtr touch, byte[] bytes, UIntPtr count);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_touch_tick(IntPtr touch, ref Reading reading, double time, out Felt felt);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_touch_disable(IntPtr touch);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_touch_traffic(IntPtr touch, out Traffic traffic);
        [DllImport(Library, CallingConvention = C)] internal static extern void palpate_touch_end(IntPtr touch);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_bridge_begin(IntPtr session, ref DeviceCalls device, ref TouchOptions options, out IntPtr bridge);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_tool_count(ref TouchOptions options, out uint count);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_two_hands(out IntPtr left, out IntPtr right);
        [DllImport(Library, CallingConvention = C)] internal static extern void palpate_hand_free(IntPtr hand);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_touch_tick_instrument(IntPtr touch, ref InstrumentReading reading, double time, out InstrumentFelt felt);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_bridge_begin_instrument(IntPtr session, ref DeviceCalls device, ref TouchOptions options, out IntPtr bridge);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_bridge_look_instrument(IntPtr bridge, out InstrumentState state);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_bridge_look(IntPtr bridge, out BridgeState state);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_bridge_disable(IntPtr bridge);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_bridge_end(IntPtr bridge, out Report report);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_surface_open(IntPtr session, ref SurfaceOptions options, out IntPtr surface);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_surface_size_of(IntPtr surface, out SurfaceSize size);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_surface_indices(IntPtr surface, int[] indices, UIntPtr capacity);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_surface_uv(IntPtr surface, float[] uv, UIntPtr stride, UIntPtr vertices);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_surface_read(IntPtr surface, ref Buffers buffers, out Dirty dirty);
        [DllImport(Library, CallingConvention = C)] internal static extern Code palpate_surface_burns(IntPtr surface, [Out] float[] burns, UIntPtr stride, UIntPtr vertices, out uint version);
        [DllImport(Library, CallingConvention = C)] internal static extern void palpate_surface_free(IntPtr surface);

        internal static void Check(Code code)
        {
            if (code != Code.Ok) throw new PalpateException(code, Text(palpate_last_error()));
        }

        internal static byte[] Utf8(string text)
        {
            return text == null ? null : Encoding.UTF8.GetBytes(text + "\0");
        }

        internal static string Text(IntPtr text)
        {
            int length = 0;
            while (Marshal.ReadByte(text, length) != 0) length++;
            var bytes = new byte[length];
            Marshal.Copy(text, bytes, 0, length);
            return Encoding.UTF8.GetString(bytes);
        }

        internal static string Text(WriteText write)
        {
            UIntPtr needed;
            Check(write(null, UIntPtr.Zero, out needed));
            var bytes = new byte[(int)needed];
            Check(write(bytes, needed, out needed));
            return Encoding.UTF8.GetString(bytes, 0, bytes.Length - 1);
        }
    }

    /// <summary>An object of the library that must be disposed of.</summary>
    public abstract class Handle : IDisposable
    {
        internal IntPtr Pointer;
        internal abstract void Free(IntPtr pointer);
        public void Dispose()
        {
            var pointer = System.Threading.Interlocked.Exchange(ref Pointer, IntPtr.Zero);
            if (pointer != IntPtr.Zero) Free(pointer);
            GC.SuppressFinalize(this);
        }
        ~Handle() { Dispose(); }
    }

    /// <summary>One of the two hands of a program; see palpate_two_hands.</summary>
    public sealed class Hand : Handle
    {
        Hand(IntPtr pointer) { Pointer = pointer; }

        /// <summary>Returns the two hands of a program.</summary>
        public static Hand[] Two()
        {
            IntPtr left, right;
            Native.Check(Native.palpate_two_hands(out left, out right));
            return new[] { new Hand(left), new Hand(right) };
        }

        internal override void Free(IntPtr pointer) { Native.palpate_hand_free(pointer); }
    }

    /// <summary>A connection to a server.</summary>
    public sealed class Server : Handle
    {
        /// <summary>The library's version.</summary>
        public static string Version { get { return Native.Text(Native.palpate_version()); } }

        /// <summary>Connects to a server. Waits for the server.</summary>
        public Server(string url, string token = null, string caPem = null, double timeout = 60.0)
        {
            ConnectOptions options;
            Native.Check(Native.palpate_connect_options_init(out options, (UIntPtr)Marshal.SizeOf(typeof(ConnectOptions))));
            byte[] ofToken = Native.Utf8(token), ofCa = Native.Utf8(caPem);
            GCHandle one = GCHandle.Alloc(ofToken, GCHandleType.Pinned), two = GCHandle.Alloc(ofCa, GCHandleType.Pinned);
            try
            {
                options.Token = one.AddrOfPinnedObject();
                options.Ca = two.AddrOfPinnedObject();
                options.Timeout = timeout;
                Native.Check(Native.palpate_connect(Native.Utf8(url), ref options, out Pointer));
            }
            finally { one.Free(); two.Free(); }
        }

        /// <summary>The names of the server's scenes. Waits for the server.</summary>
        public string[] Scenes()
        {
            return Native.Text((byte[] text, UIntPtr capacity, out UIntPtr needed) => Native.palpate_scenes(Pointer, text, capacity, out needed)).Split('\n');
        }

        /// <summary>Creates a session from a scene that the server has. Waits for the server.</summary>
        public Session Create(string scene)
        {
            IntPtr session;
            Native.Check(Native.palpate_session_create(Pointer, Native.Utf8(scene), out session));
            return new Session(session);
        }

        /// <summary>Creates a session from the text of a scene that refers to no file. Waits for the
        /// server.</summary>
        public Session CreateFromText(string scene)
        {
            IntPtr session;
            Native.Check(Native.palpate_session_create_from_text(Pointer, Native.Utf8(scene), out session));
            return new Session(session);
        }

        /// <summary>Creates a session from a local scene file, and sends its mesh. Waits for the server.</summary>
        public Session CreateFromFile(string path)
        {
            IntPtr session;
            Native.Check(Native.palpate_session_create_from_file(Pointer, Native.Utf8(path), out session));
            return new Session(session);
        }

        /// <summary>Creates a session from the text of a scene and the bytes of a mesh file. [mesh] of the scene
        /// refers to this file as `name`. `Obj` creates such bytes from an engine's mesh. Waits for the
        /// server.</summary>
        public Session CreateFromMesh(string scene, string name, byte[] bytes)
        {
            IntPtr session;
            var count = (UIntPtr)(ulong)bytes.Length;
            Native.Check(Native.palpate_session_create_from_mesh(Pointer, Native.Utf8(scene), Native.Utf8(name), bytes, count, out session));
            return new Session(session);
        }

        /// <summary>Converts a mesh in these axes to an OBJ file in Palpate's own axes. There are three coordinates
        /// for each vertex and three vertices for each triangle.</summary>
        public static byte[] Obj(float[] positions, int[] triangles, Axes axes)
        {
            var text = new StringBuilder();
            // In Unity, y and z are exchanged; in Unreal, x and y, and the unit is centimetres.
            int[] at = axes == Axes.Unity ? new[] { 0, 2, 1 } : axes == Axes.Unreal ? new[] { 1, 0, 2 } : new[] { 0, 1, 2 };
            double metres = axes == Axes.Unreal ? 0.01 : 1.0;
            for (int k = 0; k + 2 < positions.Length; k += 3)
            {
                text.Append('v');
                foreach (int axis in at) text.Append(' ').Append((metres * positions[k + axis]).ToString("R", CultureInfo.InvariantCulture));
                text.Append('\n');
            }
            // Unity's triangles are clockwise seen from outside.
            bool isTurned = axes == Axes.Unity;
            for (int k = 0; k + 2 < triangles.Length; k += 3)
            {
                int b = triangles[k + (isTurned ? 2 : 1)] + 1, c = triangles[k + (isTurned ? 1 : 2)] + 1;
                text.Append("f ").Append(triangles[k] + 1).Append(' ').Append(b).Append(' ').Append(c).Append('\n');
            }
            return Encoding.UTF8.GetBytes(text.ToString());
        }

        /// <summary>Joins a session by its id. Waits for the server.</summary>
        public Session Join(string id)
        {
            IntPtr session;
            Native.Check(Native.palpate_session_join(Pointer, Native.Utf8(id), out session));
            return new Session(session);
        }

        internal override void Free(IntPtr pointer) { Native.palpate_server_free(pointer); }
    }

    /// <summary>A session: one tissue in use.</summary>
    public sealed class Session : Handle
    {
        internal Session(IntPtr pointer) { Pointer = pointer; }

        public string Id
        {
            get { return Native.Text((byte[] text, UIntPtr capacity, out UIntPtr needed) => Native.palpate_session_id(Pointer, text, capacity, out needed)); }
        }

        public Extent Extent
        {
            get { Extent extent; Native.Check(Native.palpate_session_extent(Pointer, out extent)); return extent; }
        }

        /// <summary>Changes the tissue. Waits for the server.</summary>
        public void Apply(Change change) { Native.Check(Native.palpate_session_change(Pointer, ref change)); }

        /// <summary>The state of the session. Waits for the server.</summary>
        public Status Status
        {
            get { Status status; Native.Check(Native.palpate_session_status_of(Pointer, out status)); return status; }
        }

        /// <summary>Number of severed anchor springs. Waits for the server.</summary>
        public uint SeveredAnchors
        {
            get { uint count; Native.Check(Native.palpate_session_severed_anchors(Pointer, out count)); return count; }
        }

        /// <summary>Lays a thread through bites, or changes one that has these bites; see palpate_session_thread. Waits for the
        /// server.</summary>
        public void Thread(uint number, Vector[] bites, double length, TieOptions options)
        {
            options.Length = length;
            Lay(Native.palpate_session_thread, number, bites, options);
        }

        /// <summary>Closes a clip on two bites; see palpate_session_clip. Waits for the server.</summary>
        public void Clip(uint number, Vector[] bites, TieOptions options) { Lay(Native.palpate_session_clip, number, bites, options); }

        void Lay(LayTie lay, uint number, Vector[] bites, TieOptions options)
        {
            var pinned = GCHandle.Alloc(bites, GCHandleType.Pinned);
            try
            {
                options.Bites = pinned.AddrOfPinnedObject();
                options.BiteCount = (UIntPtr)bites.Length;
                Native.Check(lay(Pointer, number, ref options));
            }
            finally { pinned.Free(); }
        }

        /// <summary>Cuts a thread or clip by a tool, and takes it out. Waits for the server.</summary>
        public void Untie(uint tool, uint number) { Native.Check(Native.palpate_session_untie(Pointer, tool, number)); }

        /// <summary>Releases a tool that has laid threads or clips, which stay. Waits for the server.</summary>
        public void Release(uint tool) { Native.Check(Native.palpate_session_release(Pointer, tool)); }

        /// <summary>The threads and clips of the session, of all its users. Waits for the server.</summary>
        public Tie[] Ties
        {
            get
            {
                // A server has at most 64.
                var ties = new Tie[64];
                UIntPtr count;
                Native.Check(Native.palpate_session_ties(Pointer, ties, (UIntPtr)ties.Length, out count));
                Array.Resize(ref ties, (int)count);
                return ties;
            }
        }

        /// <summary>Deletes the session on the server, for all users. Waits for the server.</summary>
        public void Delete() { Native.Check(Native.palpate_session_delete(Pointer)); }

        /// <summary>Takes a tool, or an instrument, for a loop of your own. Waits for the server.</summary>
        public Touch Touch(TouchOptions options, Hand hand = null)
        {
            IntPtr touch;
            options.Hand = Of(hand);
            var code = Native.palpate_touch_begin(Pointer, ref options, out touch);
            GC.KeepAlive(hand);
            Native.Check(code);
            return new Touch(touch);
        }

        /// <summary>Connects a device, on a thread of the library. Waits for the server.</summary>
        public Bridge Bridge(IDevice device, TouchOptions options, Hand hand = null)
        {
            options.Hand = Of(hand);
            var bridge = new Bridge(Pointer, device, options);
            GC.KeepAlive(hand);
            return bridge;
        }

        /// <summary>Connects a device of six axes, on a thread of the library. The options need Jaws or Shaft. Waits for the
        /// server.</summary>
        public Bridge Bridge(IInstrumentDevice device, TouchOptions options, Hand hand = null)
        {
            options.Hand = Of(hand);
            var bridge = new Bridge(Pointer, device, options);
            GC.KeepAlive(hand);
            return bridge;
        }

        static IntPtr Of(Hand hand)
        {
            if (hand == null) return IntPtr.Zero;
            if (hand.Pointer == IntPtr.Zero) throw new ObjectDisposedException("hand");
            return hand.Pointer;
        }

        /// <summary>Gets the surface. Waits for the server.</summary>
        public Surface Surface(Axes axes, int refinement = 0, double rate = 60.0) { return new Surface(Pointer, axes, refinement, rate); }

        internal override void Free(IntPtr pointer) { Native.palpate_session_free(pointer); }
    }

    /// <summary>A tool that your own loop moves.</summary>
    public sealed class Touch : Handle
    {
        internal Touch(IntPtr pointer) { Pointer = pointer; }

        /// <summary>Creates a touch that replays recorded messages; see palpate_touch_begin_offline.</summary>
        public static Touch Offline(TouchOptions options, Vector middle)
        {
            IntPtr touch;
            Native.Check(Native.palpate_touch_begin_offline(ref options, middle, out touch));
            return new Touch(touch);
        }

        /// <summary>Delivers a recorded message; see palpate_touch_arrive.</summary>
        public void Arrive(byte[] bytes) { Native.Check(Native.palpate_touch_arrive(Pointer, bytes, (UIntPtr)bytes.Length)); }

        /// <summary>Returns the force until the next tick. Call it on your own thread, a thousand times a second. It
        /// never waits and throws no exceptions: after an error the force is zero.</summary>
        public Felt Tick(Reading reading, double time)
        {
            Felt felt;
            Native.palpate_touch_tick(Pointer, ref reading, time, out felt);
            return felt;
        }

        /// <summary>Returns force and torque until the next tick, for options with an instrument. The rules are those of the
        /// other Tick.</summary>
        public InstrumentFelt Tick(InstrumentReading reading, double time)
        {
            InstrumentFelt felt;
            Native.palpate_touch_tick_instrument(Pointer, ref reading, time, out felt);
            return felt;
        }

        /// <summary>Stops rendering until Enable goes from false to true again.</summary>
        public void Disable() { Native.Check(Native.palpate_touch_disable(Pointer)); }

        public Traffic Traffic
        {
            get { Traffic traffic; Native.palpate_touch_traffic(Pointer, out traffic); return traffic; }
        }

        internal override void Free(IntPtr pointer) { Native.palpate_touch_end(pointer); }
    }

    /// <summary>A device of your own. A thread of the library calls Read and Write a thousand times a second; an
    /// exception ends the loop. Keep them short, and allocate nothing: a garbage collection would stop
    /// them.</summary>
    public interface IDevice
    {
        Limits Limits { get; }
        Reading Read();
        void Write(Vector force);
    }

    /// <summary>A device of your own with six axes, which leads an instrument. The rules are those of IDevice. The largest
    /// torque is MaxTorque of the options.</summary>
    public interface IInstrumentDevice
    {
        Limits Limits { get; }
        InstrumentReading Read();
        void Write(Vector force, Vector torque);
    }

    /// <summary>The loop that drives a device.</summary>
    public sealed class Bridge : Handle
    {
        // The library calls these until the loop ends.
        readonly Descriptor descriptor;
        readonly Delegate read, write;
        string thrown;

        internal Bridge(IntPtr session, IDevice device, TouchOptions options)
        {
            descriptor = (IntPtr user, out Limits limits) => { limits = default(Limits); try { limits = device.Limits; return 0; } catch (Exception e) { thrown = e.Message; return 1; } };
            read = new Read((IntPtr user, out Reading reading) => { reading = default(Reading); try { reading = device.Read(); return 0; } catch (Exception e) { thrown = e.Message; return 1; } });
            write = new Write((IntPtr user, ref Vector force) => { try { device.Write(force); return 0; } catch (Exception e) { thrown = e.Message; return 1; } });
            var calls = Calls();
            Check(Native.palpate_bridge_begin(session, ref calls, ref options, out Pointer));
        }

        internal Bridge(IntPtr session, IInstrumentDevice device, TouchOptions options)
        {
            descriptor = (IntPtr user, out Limits limits) => { limits = default(Limits); try { limits = device.Limits; return 0; } catch (Exception e) { thrown = e.Message; return 1; } };
            read = new ReadInstrument((IntPtr user, ref InstrumentReading reading) => { try { reading = device.Read(); return 0; } catch (Exception e) { thrown = e.Message; return 1; } });
            write = new WriteInstrument((IntPtr user, ref Vector force, ref Vector torque) => { try { device.Write(force, torque); return 0; } catch (Exception e) { thrown = e.Message; return 1; } });
            var calls = Calls();
            Check(Native.palpate_bridge_begin_instrument(session, ref calls, ref options, out Pointer));
        }

        DeviceCalls Calls()
        {
            return new DeviceCalls
            {
                Descriptor = Marshal.GetFunctionPointerForDelegate(descriptor),
                Read = Marshal.GetFunctionPointerForDelegate(read),
                Write = Marshal.GetFunctionPointerForDelegate(write),
            };
        }

        void Check(Code code)
        {
            if (code == Code.Device && thrown != null) throw new PalpateException(code, thrown);
            Native.Check(code);
        }

        public BridgeState Look()
        {
            BridgeState state;
            Native.Check(Native.palpate_bridge_look(Pointer, out state));
            return state;
        }

        /// <summary>Returns where the instrument is and what is rendered. Throws if the device leads none.</summary>
        public InstrumentState LookInstrument()
        {
            InstrumentState state;
            Native.Check(Native.palpate_bridge_look_instrument(Pointer, out state));
            return state;
        }

        /// <summary>Stops rendering until Enable goes from false to true again. Can be called on any
        /// thread.</summary>
        public void Disable() { Native.Check(Native.palpate_bridge_disable(Pointer)); }

        /// <summary>Ends the loop and returns its statistics. Throws if the device failed.</summary>
        public Report End()
        {
            Report report;
            End(out report);
            return report;
        }

        /// <summary>Ends the loop. `report` is set even if this throws because the device failed.</summary>
        public void End(out Report report)
        {
            var pointer = System.Threading.Interlocked.Exchange(ref Pointer, IntPtr.Zero);
            var code = Native.palpate_bridge_end(pointer, out report);
            GC.KeepAlive(this);
            Check(code);
        }

        internal override void Free(IntPtr pointer) { Report report; Native.palpate_bridge_end(pointer, out report); }
    }

    /// <summary>The surface of a session, in its own arrays.</summary>
    public sealed class Surface : Handle
    {
        /// <summary>x, y, z of each vertex, one vertex after the other.</summary>
        public readonly float[] Positions;
        /// <summary>x, y, z of each vertex normal, in the same order as Positions.</summary>
        public readonly float[] Normals;
        /// <summary>Three vertex indices for each triangle.</summary>
        public readonly int[] Indices;
        /// <summary>u, v of each vertex; null if the mesh has no texture coordinates.</summary>
        public readonly float[] Uv;
        /// <summary>How burnt each vertex is by cautery, 0 to 1, as of the last ReadBurns; see palpate_surface_burns.</summary>
        public readonly float[] Burns;
        uint burnVersion;
        /// <summary>Whether the surface will receive no more updates.</summary>
        public bool IsLost { get; private set; }
        bool isRead;

        internal Surface(IntPtr session, Axes axes, int refinement, double rate)
        {
            SurfaceOptions options;
            Native.Check(Native.palpate_surface_options_init(out options, (UIntPtr)Marshal.SizeOf(typeof(SurfaceOptions))));
            options.Axes = axes;
            options.Refinement = (uint)refinement;
            options.Rate = rate;
            Native.Check(Native.palpate_surface_open(session, ref options, out Pointer));
            SurfaceSize size;
            Native.Check(Native.palpate_surface_size_of(Pointer, out size));
            Positions = new float[3 * (int)size.Vertices];
            Normals = new float[Positions.Length];
            Burns = new float[(int)size.Vertices];
            Indices = new int[(int)size.Indices];
            Native.Check(Native.palpate_surface_indices(Pointer, Indices, size.Indices));
            if (size.HasUv == 0) return;
            Uv = new float[2 * (int)size.Vertices];
            Native.Check(Native.palpate_surface_uv(Pointer, Uv, (UIntPtr)8, size.Vertices));
        }

        /// <summary>Updates positions and normals, and returns which vertices changed. Never waits.</summary>
        public Dirty Read()
        {
            GCHandle positions = GCHandle.Alloc(Positions, GCHandleType.Pinned), normals = GCHandle.Alloc(Normals, GCHandleType.Pinned);
            try
            {
                var buffers = new Buffers
                {
                    Positions = positions.AddrOfPinnedObject(), PositionsStride = (UIntPtr)12,
                    Normals = normals.AddrOfPinnedObject(), NormalsStride = (UIntPtr)12,
                    Vertices = (UIntPtr)(Positions.Length / 3), Everything = isRead ? 0u : 1u,
                };
                Dirty dirty;
                var code = Native.palpate_surface_read(Pointer, ref buffers, out dirty);
                IsLost = code == Code.Connection;
                if (!IsLost) Native.Check(code);
                isRead = true;
                return dirty;
            }
            finally { positions.Free(); normals.Free(); }
        }

        /// <summary>Updates how burnt each vertex is, and returns whether that has changed. Never waits.</summary>
        public bool ReadBurns()
        {
            uint version;
            Native.Check(Native.palpate_surface_burns(Pointer, null, UIntPtr.Zero, UIntPtr.Zero, out version));
            if (version == burnVersion) return false;
            Native.Check(Native.palpate_surface_burns(Pointer, Burns, (UIntPtr)4, (UIntPtr)Burns.Length, out burnVersion));
            return true;
        }

        internal override void Free(IntPtr pointer) { Native.palpate_surface_free(pointer); }
    }
}
