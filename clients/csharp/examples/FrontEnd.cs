// A complete front end in a terminal: `FrontEnd.exe URL SCENE SECONDS`. A device moves up and down in the middle, on
// a thread of the library; this thread shows force and surface, and makes the tissue softer at half time.
using System;
using System.Globalization;
using System.Threading;
using Palpate;

/// Replace this with the calls of your device's SDK.
class Mine : IDevice
{
    long ticks;
    public double Most;
    public Limits Limits { get { return Limits.Of("omega3"); } }
    public Reading Read()
    {
        double z = 0.0005 + 0.0035 * Math.Cos(Math.PI * ticks++ / 1000.0);
        // The button, pressed twice a second.
        return new Reading(new Vector(0.0, 0.0, z), ticks % 500 < 250);
    }
    public void Write(Vector force) { Most = Math.Max(Most, force.Z); }
}

static class FrontEnd
{
    static int Main(string[] arguments)
    {
        double seconds = double.Parse(arguments[2], CultureInfo.InvariantCulture);
        var device = new Mine();
        using (var server = new Server(arguments[0]))
        using (var session = server.Create(arguments[1]))
        using (var surface = session.Surface(Axes.Own))
        using (var bridge = session.Bridge(device, TouchOptions.Default))
        {
            int frames = (int)(60 * seconds);
            for (int frame = 0; frame < frames; frame++)
            {
                var dirty = surface.Read();
                float deepest = 0;
                for (int k = 2; k < surface.Positions.Length; k += 3) deepest = Math.Min(deepest, surface.Positions[k]);
                var state = bridge.Look();
                Console.Error.Write(FormattableString.Invariant($"\rforce {state.Force.Z:F3} N, deepest {1e3 * deepest:F2} mm, {dirty.Count} vertices new "));
                if (frame == frames / 2)
                {
                    var softer = Change.None;
                    softer.Stiffness = 20.0;
                    session.Apply(softer);
                }
                Thread.Sleep(16);
            }
            var report = bridge.End();
            Console.WriteLine("{\"ticks\":" + report.Ticks + ",\"force_max_n\":" + device.Most.ToString("F4", CultureInfo.InvariantCulture) + "}");
            session.Delete();
        }
        return 0;
    }
}
