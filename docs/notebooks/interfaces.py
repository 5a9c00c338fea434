# %% [markdown]
# # interfaces
# %%
print(1)
