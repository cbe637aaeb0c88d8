// Cuts a tissue, sews it and burns it: `Cut.exe URL SCENE`, for a sheet such as liver. A device of your own leads a blade; then a thread
// through four places draws the lips of the cut together; then a hot tip is held on a place until that has burnt through.
using System;
using System.Globalization;
using System.Linq;
using System.Threading;
using Palpate;

/// Goes down to 6 mm below the surface, 30 mm ahead along y, and up again.
class Scalpel : IDevice
{
    long ticks;
    public Limits Limits { get { return Limits.Of("omega3"); } }
    public Reading Read()
    {
        double time = 1e-3 * ticks++;
        double down = Part(Math.Min(time, 2.5 - time) / 0.5), along = Part((time - 0.5) / 1.5);
        return new Reading(new Vector(-0.00125, -0.015 + 0.03 * along, 0.004 - 0.010 * down), true);
    }
    public void Write(Vector force) { }
    static double Part(double value) { return Math.Max(0.0, Math.Min(1.0, value)); }
}

/// A hot tip that stays 2 mm below the surface, beside the cut.
class Cautery : IDevice
{
    long ticks;
    public Limits Limits { get { return Limits.Of("omega3"); } }
    public Reading Read() { return new Reading(new Vector(0.02, 0.0, 0.002 - 0.004 * Math.Min(1e-3 * ticks++ / 0.5, 1.0)), true); }
    public void Write(Vector force) { }
}

static class Cut
{
    static int Main(string[] arguments)
    {
        using (var server = new Server(arguments[0]))
        using (var session = server.Create(arguments[1]))
        {
            var options = TouchOptions.Default;
            options.TipShape = TipShape.Blade;
            options.TipRadius = 0.001;
            options.Edge = new Vector(0.0, 0.0, 0.02);
            using (var bridge = session.Bridge(new Scalpel(), options))
            {
                while (!bridge.Look().IsOver && bridge.Look().Ticks < 2600) Thread.Sleep(10);
                bridge.End();
            }
            Vector top = session.Extent.Top;
            var bites = new Vector[4];
            for (int bite = 0; bite < 4; bite++)
                bites[bite] = new Vector(top.X - 0.00125 + (bite % 2 == 1 ? 0.004 : -0.004), top.Y - 0.006 + 0.004 * bite, top.Z);
            session.Thread(0, bites, 0.02, TieOptions.Default);
            var thread = default(Tie);
            for (int look = 0; look < 5000 && !(thread.Tension > 0.0 && thread.Path < 0.021); look++, Thread.Sleep(10))
                foreach (Tie tie in session.Ties) thread = tie;
            Status status = session.Status;
            session.Untie(0, 0);

            var heat = TouchOptions.Default;
            heat.TipRadius = 0.003;
            heat.Burn = 0.3;
            heat.Tool = 1;
            int burnt = 0;
            using (var surface = session.Surface(Axes.Own))
            using (var bridge = session.Bridge(new Cautery(), heat))
            {
                for (int look = 0; look < 6000 && burnt == 0; look++, Thread.Sleep(10))
                    if (surface.ReadBurns()) burnt = surface.Burns.Count(burn => burn >= 1.0f);
                bridge.End();
            }
            Console.WriteLine(string.Format(CultureInfo.InvariantCulture,
                "{{\"severed\":{0},\"pieces\":{1},\"version\":{2},\"thread_m\":{3:F5},\"tension_n\":{4:F4},\"burnt\":{5},\"anchors\":{6}",
                status.Severed, status.Pieces, status.TopologyVersion, thread.Path, thread.Tension, burnt, session.SeveredAnchors) + "}");
            session.Delete();
        }
        return 0;
    }
}
