// Errors are exceptions with a message: `Errors.exe URL`.
using System;
using System.Linq;
using Palpate;

static class Errors
{
    static int failures;

    static void Expect(Code code, string words, Action call)
    {
        try { call(); }
        catch (PalpateException e) when (e.Code == code && e.Message.Contains(words)) { return; }
        catch (Exception e) { Console.Error.WriteLine(e); }
        Console.Error.WriteLine("no " + code + " with the words: " + words);
        failures++;
    }

    class Failing : IDevice
    {
        int reads;
        public Limits Limits { get { return Limits.Of("touch"); } }
        public Reading Read() { if (++reads > 2000) throw new Exception("the cable is out"); return default(Reading); }
        public void Write(Vector force) { }
    }

    /// Turns by a wrong length after a while.
    class Turning : IInstrumentDevice
    {
        public int Reads;
        public Vector LastForce = new Vector(1, 1, 1), LastTorque = new Vector(1, 1, 1);
        public Limits Limits { get { return Limits.Of("sigma7"); } }
        public InstrumentReading Read()
        {
            return new InstrumentReading(new Vector(0, 0, 0.02), new Orientation(++Reads > 2000 ? 0.5 : 1.0, 0, 0, 0), 0.5, true);
        }
        public void Write(Vector force, Vector torque) { LastForce = force; LastTorque = torque; }
    }

    static void TryInstruments(Session session)
    {
        var options = TouchOptions.Default;
        if (options.Handle != 0.33 || options.HasPort || options.ToolCount != 1) failures++;
        options.Jaws = double.NaN;
        Expect(Code.Argument, "jaws_m", () => Console.Write(options.ToolCount));
        options.Jaws = 0.015;
        options.Handle = 9.0;
        Expect(Code.Argument, "handle_m", () => Console.Write(options.ToolCount));
        options.Handle = 0.33;
        options.MaxTorque = 0.4;
        options.InTissueFrame = true;
        options.Limits.WorkspaceRadius = 1.0;
        options.HasPort = true;
        var top = session.Extent.Top;
        options.Port = new Vector(top.X, top.Y - 0.05, top.Z + 0.1);
        var hands = Hand.Two();
        using (var touch = session.Touch(options, hands[0]))
        {
            Expect(Code.Argument, "used this hand", () => session.Touch(options, hands[0]));
            // The shaft passes through the port.
            var reading = new InstrumentReading(new Vector(top.X, top.Y, top.Z + 0.02), Orientation.Identity, 0.5, true);
            var q = touch.Tick(reading, 0.001).Orientation;
            double size = Math.Sqrt(0.05 * 0.05 + 0.08 * 0.08);
            if (Math.Abs(1 - 2 * (q.Y * q.Y + q.Z * q.Z)) > 1e-9 || Math.Abs(2 * (q.X * q.Y + q.W * q.Z) - 0.05 / size) > 1e-9) failures++;
            reading.Orientation = default(Orientation);
            if (touch.Tick(reading, 0.002).State != State.Fault) failures++;
        }
        options.InTissueFrame = false;
        var device = new Turning();
        var bridge = session.Bridge(device, options, hands[1]);
        while (!bridge.LookInstrument().IsOver) System.Threading.Thread.Sleep(10);
        if (bridge.LookInstrument().JawAngle != 0.5) failures++;
        Expect(Code.Device, "length is not 1", () => bridge.End());
        if (device.LastForce.Length != 0 || device.LastTorque.Length != 0) failures++;
        hands[0].Dispose();
        bool isRefused = false;
        try { session.Touch(options, hands[0]); } catch (ObjectDisposedException) { isRefused = true; }
        if (!isRefused) failures++;
        hands[1].Dispose();
        Expect(Code.Argument, "jaws_m", () => session.Bridge(new Turning(), TouchOptions.Default));
    }

    static int Main(string[] arguments)
    {
        Expect(Code.Argument, "must begin with", () => new Server("ftp://nowhere"));
        Expect(Code.Connection, "can't reach", () => new Server("http://127.0.0.1:1"));
        Expect(Code.Argument, "spoon", () => Limits.Of("spoon"));
        Expect(Code.Argument, "no token", () => new Server(arguments[0], token: "two words"));
        using (var server = new Server(arguments[0]))
        {
            if (!server.Scenes().Contains("liver") || Server.Version != "0.1.0") failures++;
            Expect(Code.Refused, "nowhere", () => server.Create("nowhere"));
            // A mesh in Unity's axes: y points up, and triangles are clockwise.
            const string scene = "[mesh]\nfile = \"ball.obj\"\nunit = \"m\"\npoint_mass_kg = 0.01\n[springs]\nstiffness_n_per_m = 100.0\n"
                + "[anchor_springs]\nstiffness_n_per_m = 5.0\n[damping]\ncoefficient_n_s_per_m = 1.0\n";
            float[] corners = { 0.05f, 0, 0, -0.05f, 0, 0, 0, 0.07f, 0, 0, -0.07f, 0, 0, 0, 0.05f, 0, 0, -0.05f };
            int[] faces = { 0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5 };
            Expect(Code.Argument, "names a file", () => server.CreateFromText(scene));
            Expect(Code.Argument, "cube.obj", () => server.CreateFromMesh(scene, "cube.obj", Server.Obj(corners, faces, Axes.Unity)));
            Expect(Code.Argument, "nowhere.toml", () => server.CreateFromFile("nowhere.toml"));
            using (var own = server.CreateFromMesh(scene, "ball.obj", Server.Obj(corners, faces, Axes.Unity)))
            {
                if (Math.Abs(own.Extent.Most.Z - 0.07) > 1e-6 || Math.Abs(own.Extent.Most.Y - 0.05) > 1e-6) failures++;
                own.Delete();
            }
            using (var session = server.Create("liver"))
            using (var joined = server.Join(session.Id))
            {
                Expect(Code.Refused, "", () => joined.Apply(Change.None));
                if (joined.Extent.Middle.X != session.Extent.Middle.X) failures++;
                // The fields of the structures must be at the same offsets as in the library.
                if (TouchOptions.Default.Friction != 0.2 || TouchOptions.Default.Limits.WorkspaceRadius != 0.075 || !TouchOptions.Default.RealTime) failures++;
                using (var surface = session.Surface(Axes.Own))
                {
                    var dirty = surface.Read();
                    if (dirty.First != 0 || dirty.Count != surface.Positions.Length / 3 || surface.IsLost) failures++;
                    if (surface.Uv == null || surface.Indices.Any(k => k < 0 || k >= dirty.Count)) failures++;
                }
                var bridge = session.Bridge(new Failing(), TouchOptions.Default);
                while (!bridge.Look().IsOver) System.Threading.Thread.Sleep(10);
                if (bridge.Look().Ticks < 2000) failures++;
                bridge.Disable();
                var report = default(Report);
                Expect(Code.Device, "the cable is out", () => bridge.End(out report));
                if (report.Result != Code.Device || report.Ticks == 0 || report.Connections == 0) failures++;
                TryInstruments(session);
                session.Delete();
                Expect(Code.Refused, "", () => session.Touch(TouchOptions.Default));
            }
        }
        Console.WriteLine(failures + " failures");
        return failures == 0 ? 0 : 1;
    }
}
