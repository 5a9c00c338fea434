# %% [markdown]
# # idea
# %%
print(1)
