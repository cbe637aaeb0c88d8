// Watches a tissue: `Look.exe URL SCENE SECONDS`. Prints one line of JSON.
using System;
using System.Globalization;
using System.Threading;
using Palpate;

static class Look
{
    static int Main(string[] arguments)
    {
        double seconds = double.Parse(arguments[2], CultureInfo.InvariantCulture);
        using (var server = new Server(arguments[0]))
        using (var session = server.Create(arguments[1]))
        using (var surface = session.Surface(Axes.Unity))
        {
            var dirty = default(Dirty);
            for (int frame = 0; frame < 60 * seconds; frame++)
            {
                dirty = surface.Read();
                Thread.Sleep(16);
            }
            float least = float.MaxValue, most = float.MinValue;
            // In Unity, y points up.
            for (int k = 1; k < surface.Positions.Length; k += 3)
            {
                least = Math.Min(least, surface.Positions[k]);
                most = Math.Max(most, surface.Positions[k]);
            }
            Console.WriteLine(FormattableString.Invariant(
                $"{{\"vertices\":{surface.Positions.Length / 3},\"triangles\":{surface.Indices.Length / 3},\"frames\":{dirty.Frames},\"y_m\":[{least:F6},{most:F6}]}}"));
            session.Delete();
        }
        return 0;
    }
}
