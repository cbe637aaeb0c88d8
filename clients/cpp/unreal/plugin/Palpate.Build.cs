// Palpate's tests do not build it, because they have no Unreal.
using System.IO;
using UnrealBuildTool;

public class Palpate : ModuleRules
{
    public Palpate(ReadOnlyTargetRules Target) : base(Target)
    {
        PCHUsage = PCHUsageMode.UseExplicitOrSharedPCHs;
        PublicDependencyModuleNames.AddRange(new[] { "Core", "CoreUObject", "Engine", "ProceduralMeshComponent" });
        string library = Path.Combine(PluginDirectory, "Source", "ThirdParty", "Palpate");
        PublicSystemIncludePaths.Add(Path.Combine(library, "include"));
        string file = Path.Combine(library, "lib", "Linux", "libpalpate.so.0");
        PublicAdditionalLibraries.Add(file);
        PublicRuntimeLibraryPaths.Add(Path.GetDirectoryName(file));
        RuntimeDependencies.Add(file);
    }
}
